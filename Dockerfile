# Images of the service, one target each:
#   api      web process, migration: neither torch nor warp
#   worker   dispatcher, simulation workers: warp
#   trainer  training workers: warp and torch
#   inference  rollouts, plans, films and live sessions: warp, torch and what encodes films
# Dependencies are installed before the source is copied, so that a change of code rebuilds one small layer.
# Build arguments: PIP_INDEX_URL and PIP_EXTRA_INDEX_URL where packages come from another index (the pinned CPU
# build of torch lies on its project's own index). The classic builder forgets them at the end of a stage.
ARG PYTHON_IMAGE=python:3.11.14-slim-bookworm

FROM ${PYTHON_IMAGE} AS base
ENV PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    HOME=/var/lib/physworld \
    PHYSWORLD_DATA_DIR=/var/lib/physworld \
    WARP_CACHE_PATH=/var/cache/physworld/warp
RUN groupadd --gid 10001 physworld \
    && useradd --uid 10001 --gid 10001 --home-dir /var/lib/physworld --shell /usr/sbin/nologin physworld \
    && mkdir -p /var/lib/physworld /var/cache/physworld \
    && chown 10001:10001 /var/lib/physworld /var/cache/physworld
WORKDIR /app
COPY pyproject.toml requirements.lock scripts/requirements.py scripts/install_torch.sh ./

FROM base AS api
ARG PIP_INDEX_URL=
ARG PIP_EXTRA_INDEX_URL=
RUN python requirements.py api tables > requirements.txt \
    && pip install --no-deps --require-hashes -r requirements.txt
COPY schemas/ physworld_schemas/
COPY storage/ physworld_storage/
COPY scenes/ physworld_scenes/
COPY physworld/ physworld/
COPY services/__init__.py services/connections.py services/interpreter.py services/stores.py services/web.py physworld_services/
COPY services/api/ physworld_services/api/
COPY services/dashboard/ physworld_services/dashboard/
COPY services/guide/ physworld_services/guide/
COPY clients/python/physworld_client/ physworld_client/
USER 10001:10001
EXPOSE 8000
CMD ["python", "-m", "physworld_services.web", "--host", "0.0.0.0", "--port", "8000"]

FROM base AS worker
ARG PIP_INDEX_URL=
ARG PIP_EXTRA_INDEX_URL=
RUN python requirements.py api sim > requirements.txt \
    && pip install --no-deps --require-hashes -r requirements.txt
ENV MPLCONFIGDIR=/var/cache/physworld/matplotlib
COPY schemas/ physworld_schemas/
COPY storage/ physworld_storage/
COPY scenes/ physworld_scenes/
COPY physworld/ physworld/
COPY workers/ physworld_workers/
USER 10001:10001
CMD ["python", "-m", "physworld_workers"]

FROM base AS trainer
ARG PIP_INDEX_URL=
ARG PIP_EXTRA_INDEX_URL=
RUN python requirements.py api sim train > requirements.txt \
    && pip install --no-deps --require-hashes -r requirements.txt \
    && ./install_torch.sh python
ENV MPLCONFIGDIR=/var/cache/physworld/matplotlib
COPY schemas/ physworld_schemas/
COPY storage/ physworld_storage/
COPY scenes/ physworld_scenes/
COPY physworld/ physworld/
COPY workers/ physworld_workers/
COPY services/__init__.py physworld_services/
COPY services/trainer/ physworld_services/trainer/
USER 10001:10001
CMD ["python", "-m", "physworld_services.trainer"]

FROM base AS inference
ARG PIP_INDEX_URL=
ARG PIP_EXTRA_INDEX_URL=
RUN python requirements.py api sim train video > requirements.txt \
    && pip install --no-deps --require-hashes -r requirements.txt \
    && ./install_torch.sh python
ENV MPLCONFIGDIR=/var/cache/physworld/matplotlib
COPY schemas/ physworld_schemas/
COPY storage/ physworld_storage/
COPY scenes/ physworld_scenes/
COPY physworld/ physworld/
COPY workers/ physworld_workers/
COPY services/__init__.py physworld_services/
COPY services/inference/ physworld_services/inference/
USER 10001:10001
EXPOSE 8100
CMD ["python", "-m", "physworld_services.inference", "serve", "--host", "0.0.0.0"]
