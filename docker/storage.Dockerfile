# An S3-compatible object store on one disk: SeaweedFS, in the version that the tests run.
#   docker build -f docker/storage.Dockerfile -t penumbra/storage:0.1.0 .
# Pin by digest with --build-arg SEAWEEDFS=4.48@sha256:… (docker buildx imagetools inspect chrislusf/seaweedfs:4.48).
ARG SEAWEEDFS=4.48
ARG ALPINE=3.22.2

FROM chrislusf/seaweedfs:${SEAWEEDFS} AS weed

FROM alpine:${ALPINE} AS storage
COPY --from=weed /usr/bin/weed /usr/local/bin/weed
COPY --chmod=755 docker/with-secrets /usr/local/bin/with-secrets
RUN addgroup -g 10001 penumbra \
    && adduser -D -H -u 10001 -G penumbra penumbra \
    && install -d -o penumbra -g penumbra -m 700 /var/lib/seaweedfs
USER 10001:10001
WORKDIR /var/lib/seaweedfs
VOLUME /var/lib/seaweedfs
EXPOSE 8333
ENTRYPOINT ["/usr/local/bin/with-secrets"]
# Only S3 is reachable from outside: the other ports ask for no key.
CMD ["weed", "-logtostderr=true", "server", "-ip=127.0.0.1", "-ip.bind=127.0.0.1", "-dir=/var/lib/seaweedfs", \
    "-volume.max=0", "-volume.preStopSeconds=1", "-master.volumeSizeLimitMB=1024", "-master.telemetry=false", \
    "-filer", \
    "-s3", "-s3.ip.bind=0.0.0.0", "-s3.port=8333", "-s3.port.iceberg=0", "-s3.port.lance=0"]
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s --retries=6 \
    CMD ["wget", "--quiet", "--output-document=/dev/null", "http://127.0.0.1:8333/healthz"]
