#!/bin/sh
# Arguments are SeaweedFS's and not looked at.
set -eu
mkdir -p "/data/$S3_BUCKET"
# The value is a list of pairs in CSV, hence the quotes.
export RCLONE_AUTH_KEY="\"$AWS_ACCESS_KEY_ID,$AWS_SECRET_ACCESS_KEY\"" RCLONE_CONFIG=/tmp/rclone.conf
# SeaweedFS's filer, which needs no key either.
python3 -m http.server 8888 --bind 0.0.0.0 --directory /data &
exec rclone serve s3 /data --addr 0.0.0.0:8333 --vfs-cache-mode off
