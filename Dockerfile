# fcslam in a container, with what deploy/requirements.lock pins. Without a container runtime, run tools/dockerfile_in_root.py.
#
#     docker build -t fcslam .
#     docker run --rm -v "$PWD":/data fcslam map robot1.bag robot2.bag -o runs/building
#     docker run -p 8340:8340 -v "$PWD":/data fcslam serve --data cloud --host 0.0.0.0 --credentials credentials
FROM debian:bookworm-slim@sha256:7b140f374b289a7c2befc338f42ebe6441b7ea838a042bbd5acbfca6ec875818

RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3 python3-venv ca-certificates \
    && rm -rf /var/lib/apt/lists/*

COPY deploy/requirements.lock pyproject.toml README.md LICENSE /src/
COPY src /src/src
RUN python3 -m venv /opt/fcslam \
    && /opt/fcslam/bin/pip install --no-cache-dir --no-deps --require-hashes -r /src/requirements.lock \
    && /opt/fcslam/bin/pip install --no-cache-dir --no-deps --no-build-isolation /src \
    && rm -rf /src

# Compiled code is kept here. It is made ahead, and again where the processor is another one.
ENV NUMBA_CACHE_DIR=/var/cache/fcslam PATH=/opt/fcslam/bin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
RUN useradd --uid 1000 --create-home fcslam \
    && install --directory --owner fcslam /data /var/cache/fcslam
USER fcslam
RUN fcslam tools warm-up

WORKDIR /data
VOLUME /data
EXPOSE 8340
ENTRYPOINT ["fcslam"]
CMD ["--help"]
