#!/bin/sh
# Accepts --agent-port and --server-port like rcssserver3d, and stores the monitor port for the health check.
set -eu
previous=
monitor=3200
for argument in "$@"; do
  [ "$previous" = --server-port ] && monitor=$argument
  previous=$argument
done
echo "$monitor" > /tmp/monitor-port
exec rcssserver3d --script-path /usr/local/share/naosim/trainer.rb "$@"
