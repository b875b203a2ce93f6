# Debian's Redis under the names that Valkey's programs have.
FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends redis-server \
    && rm -rf /var/lib/apt/lists/* \
    && ln -s redis-cli /usr/bin/valkey-cli \
    && install -d -o 999 -g 999 /data
COPY broker-server.sh /usr/bin/valkey-server
VOLUME /data
WORKDIR /data
EXPOSE 6379
