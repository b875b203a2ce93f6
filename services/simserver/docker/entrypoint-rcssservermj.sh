#!/bin/sh
# Accepts the arguments of rcssservermj, and stores the monitor port for the health check.
set -eu
previous=
monitor=60001
for argument in "$@"; do
  [ "$previous" = --mport ] && monitor=$argument
  previous=$argument
done
echo "$monitor" > /tmp/monitor-port
[ $# -gt 0 ] || set -- --sync --no-realtime --no-render
exec rcssservermj --host 0.0.0.0 "$@"
