# gonio in a container: `docker compose up`, or see docs/howto/run-it.md.

FROM node:22-slim AS dashboard
WORKDIR /src/service/dashboard
COPY service/dashboard/package.json service/dashboard/package-lock.json ./
RUN npm ci --no-fund --no-audit
COPY service/dashboard ./
RUN mkdir -p ../gonio/http && npm run build

FROM python:3.11-slim AS builder
WORKDIR /src
RUN python -m venv /opt/gonio
COPY requirements.lock ./
# Every package is pinned and hashed; the lock names no index.
RUN /opt/gonio/bin/pip install --no-cache-dir --require-hashes -r requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY models models
COPY calibration_boards calibration_boards
COPY service/gonio service/gonio
COPY --from=dashboard /src/service/gonio/http/page service/gonio/http/page
RUN /opt/gonio/bin/pip install --no-cache-dir --no-deps --no-build-isolation .

FROM python:3.11-slim
RUN useradd --uid 10001 --create-home gonio && install -d -o gonio -g gonio /data /cache
COPY --from=builder /opt/gonio /opt/gonio
ENV PATH=/opt/gonio/bin:$PATH \
    GONIO_DATA_DIR=/data GONIO_CACHE_DIR=/cache NUMBA_CACHE_DIR=/cache/numba \
    GONIO_HOST=0.0.0.0 GONIO_LOG_FORMAT=json
USER gonio
VOLUME ["/data", "/cache"]
EXPOSE 8000
# The service stops in peace on SIGTERM within ten seconds: requests get three, workers five.
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=3s --start-period=60s \
  CMD ["python", "-c", "import urllib.request as u; u.urlopen('http://127.0.0.1:8000/healthz', timeout=2)"]
CMD ["gonio", "serve"]
