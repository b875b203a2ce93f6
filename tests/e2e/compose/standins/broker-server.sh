#!/bin/sh
# Start Debian's Redis as valkey-server. It is older than CLIENT SETINFO, which deploy/broker/start allows its users.
sed -i 's/ +client|setinfo//' "${BROKER_ACL:-/tmp/users.acl}"
exec redis-server "$@"
