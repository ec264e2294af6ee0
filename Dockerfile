# docker build -t softgrasp .   (not built by its authors, who had no network for it: read it line by line)
FROM python:3.12-slim-bookworm
# A C compiler, because DOLFINx compiles forms; EGL, because `softgrasp view --save` draws without a screen.
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev libegl1 libgl1 libxrender1 \
    && rm -rf /var/lib/apt/lists/* && mkdir -m 1777 /opt/cache
ENV OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 XDG_CACHE_HOME=/opt/cache
WORKDIR /src
COPY . .
RUN pip install --no-cache-dir '.[solver,view]'
RUN python tools/compile_forms.py && chmod 1777 /opt/cache/*
WORKDIR /data
ENTRYPOINT ["softgrasp"]
