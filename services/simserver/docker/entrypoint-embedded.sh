#!/bin/sh
# Takes --agent-port and --server-port, as rcssserver3d does, and remembers the monitor port for the health check.
set -eu
previous=
monitor=3200
for argument in "$@"; do
  [ "$previous" = --server-port ] && monitor=$argument
  previous=$argument
done
echo "$monitor" > /tmp/monitor-port
exec naosim serve --host 0.0.0.0 --sync "$@"
