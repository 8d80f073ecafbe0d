# pano_mvs on a CPU. In a checkout:
#   docker build --tag pano_mvs .
#   docker run --rm --user "$(id -u):$(id -g)" --volume "$PWD:/work" --volume pano_mvs:/cache pano_mvs run quickstart
FROM python:3.12-slim

# EGL and Mesa draw `view --screenshot` without a display.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libgl1-mesa-dri libgomp1 \
    && rm -rf /var/lib/apt/lists/*

COPY pyproject.toml hatch_build.py README.md LICENSE /src/
COPY pano_mvs /src/pano_mvs
COPY plugins /src/plugins
COPY workflows /src/workflows
RUN pip install --no-cache-dir '/src[exr,heic]' && rm -rf /src

# Compiled kernels are stored here. Mount a volume to keep them between runs; any user may write.
RUN mkdir --mode=1777 /cache
ENV XDG_CACHE_HOME=/cache MPLCONFIGDIR=/cache/matplotlib

# Mount the folder with your images here. Results and the cache of the stages are written into it.
WORKDIR /work
ENTRYPOINT ["pano-mvs"]
CMD ["--help"]
