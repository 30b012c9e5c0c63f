# docker build -t cathsim . && docker run --rm cathsim
FROM python:3.12-slim
RUN apt-get update && apt-get install -y --no-install-recommends make git libgomp1 && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=disable PIP_NO_CACHE_DIR=1
WORKDIR /cathsim
COPY . .
RUN python -m venv .venv && .venv/bin/pip install --no-deps -r requirements.lock \
    --extra-index-url https://download.pytorch.org/whl/cpu
RUN .venv/bin/pip install --no-deps -e . && touch .venv/.created && touch .venv/.installed && touch .venv/.installed-test
CMD ["make", "test"]
