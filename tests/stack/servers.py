"""PostgreSQL, an S3 server and `mlflow server`, with the commands and environment of the compose file.

    with Stack(folder) as stack:
        run(…, env=os.environ | stack.environment)   # MLFLOW_TRACKING_*, AWS_*
        stack.tracking.kill()                        # and stack.database, stack.storage
        stack.tracking.start()

`python -m tests.stack.servers FOLDER` starts the servers, prints the environment and waits for Ctrl-C.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.stack.compose import FOLDER, Service, read_compose, read_services, settings
from tests.stack.processes import Server, free_ports

# Ports that services listen on in their containers.
PORTS = {"database": "5432", "storage": "8333", "tracking": "5000", "serve": "8080"}
# What nobody outside the machine's loopback may reach, so that the compose file need not name it.
INNER_PORTS = ("master", "volume", "filer")


class Stack:
    """The servers of the compose file on free ports of the loopback interface.

    Args:
        folder: Empty folder for data, logs and secrets.
        variables: Values for `.env`, over those of `.env.example`.

    Attributes:
        database, storage, tracking: Servers; `start`, `stop`, `kill`, `freeze`, `thaw` each by itself.
        environment: What a trainer needs: address and account of the tracking server, address and keys of
            the store.
        tracking_uri: Address of the tracking server.
        artifact_bucket, bucket_url: Bucket of artifacts (a name); URL of the bucket for data.
    """

    def __init__(self, folder: Path, variables: dict[str, str] | None = None) -> None:
        self.folder = folder.resolve()
        self.variables = settings() | (variables or {})
        self.services = read_services(read_compose(self.variables))
        self.ports = dict(zip(PORTS, map(str, free_ports(len(PORTS))), strict=True))
        self._owner = _ordinary_user()
        self._database_folder: Path | None = None
        self._programs = _programs()
        self.artifact_bucket = self.variables["ARTIFACT_BUCKET"]
        self.bucket_url = f"s3://{self.variables['DATA_BUCKET']}"
        self.tracking_uri = f"http://127.0.0.1:{self.ports['tracking']}"
        self.environment: dict[str, str] = {}
        self.servers: dict[str, Server] = {}

    @property
    def database(self) -> Server:
        """PostgreSQL."""
        return self.servers["database"]

    @property
    def storage(self) -> Server:
        """The S3 server."""
        return self.servers["storage"]

    @property
    def tracking(self) -> Server:
        """`mlflow server`."""
        return self.servers["tracking"]

    def __enter__(self) -> Stack:
        self.start()
        return self

    def __exit__(self, *args: object) -> None:
        self.close()

    def start(self) -> None:
        """Make secrets and data folders, start all servers, create buckets and accounts.

        Raises:
            ServerError: A server does not run.
        """
        atexit.register(self.close)
        try:
            self._prepare()
            self.database.start()
            self.storage.start()
            self.tracking.start()
            self.run_service("set-up")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End all servers at once and remove the database's folder."""
        atexit.unregister(self.close)
        for name, server in reversed(self.servers.items()):
            # PostgreSQL would leave shared memory behind if it were killed.
            server.stop(signal.SIGQUIT if name == "database" else signal.SIGKILL)
        if self._database_folder is not None:
            shutil.rmtree(self._database_folder, ignore_errors=True)

    def run_service(self, name: str, *, check: bool = True) -> str:
        """Run a service that ends by itself and return what it printed.

        Raises:
            RuntimeError: It failed.
        """
        service = self.services[name]
        done = subprocess.run(
            self.words([*service.entrypoint, *service.command], service), env=self.service_environment(name),
            cwd=self.folder, capture_output=True, text=True, timeout=180,
        )  # fmt: skip
        if check and done.returncode:
            raise RuntimeError(f"the service {name} failed\n{done.stdout}{done.stderr}")
        return done.stdout + done.stderr

    def make_server(self, name: str, folder: Path | None = None, more: tuple[str, ...] = ()) -> Server:
        """Return the server of a service, not started, with a working directory of its own."""
        folder = folder or self.folder / name
        folder.mkdir(exist_ok=True)
        service = self.services[name]
        return Server(
            [*self.words([*service.entrypoint, *service.command], service), *more],
            self.service_environment(name), folder, self.folder / f"{name}.log",
            health=self.words(service.health, service),
        )  # fmt: skip

    def words(self, words: list[str], service: Service) -> list[str]:
        """Return a command of a container as one of this machine."""
        if words and words[0] == "/usr/bin/tini":
            words = words[2:]  # passes signals on where a program is the first process
        program, *rest = [self._translate(word, service) for word in words]
        return [shutil.which(program, path=self._programs) or program, *rest]

    def service_environment(self, name: str) -> dict[str, str]:
        """Return the environment of a service: its own, and only PATH and HOME of this machine."""
        service = self.services[name]
        own = {key: self._translate(value, service) for key, value in service.environment.items()}
        own |= {key: "127.0.0.1" for key, value in own.items() if value in PORTS and key.endswith("HOST")}
        kept = {"PYTHONPATH": os.environ["PYTHONPATH"]} if "PYTHONPATH" in os.environ else {}
        return {"PATH": self._programs, "HOME": str(self.folder), "LANG": "C.UTF-8"} | kept | own

    def _translate(self, text: str, service: Service) -> str:
        """Replace hosts, ports and paths of a container."""
        places: dict[str, Path] = {"/run/secrets": self.folder / "secrets"} | service.paths
        places |= {target: self.folder / volume for target, volume in service.volumes.items()}
        for target, place in sorted(places.items(), reverse=True):
            text = re.sub(rf"{re.escape(target)}(?=/|$)", str(place), text)
        text = re.sub(rf"(?<=//)(?:{'|'.join(PORTS)})(?=:\d)|\b0\.0\.0\.0\b", "127.0.0.1", text)
        for name, port in PORTS.items():
            text = re.sub(rf"(?<![\w.]){port}(?!\w)", self.ports[name], text)
        return text

    def _prepare(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        subprocess.run([FOLDER / "make-secrets", self.folder / "secrets"], check=True, capture_output=True)
        for name in ("storage", "tracking"):
            self.servers[name] = self.make_server(name)
        self.storage.command += self._storage_options()
        self.servers = {"database": self._make_database(), **self.servers}
        self.environment = self._client_environment()

    def _storage_options(self) -> list[str]:
        ports = iter(free_ports(2 * len(INNER_PORTS) + 1))
        options = [f"-s3.port.grpc={next(ports)}", f"-s3.localSocket={self.folder / 's3.sock'}"]
        for part in INNER_PORTS:
            options += [f"-{part}.port={next(ports)}", f"-{part}.port.grpc={next(ports)}"]
        return [*options, f"-filer.localSocket={self.folder / 'filer.sock'}"]

    def _make_database(self) -> Server:
        """Do what the image's entry point does in an empty volume: cluster, role, databases, scripts."""
        if shutil.which("initdb", path=self._programs) is None:
            raise FileNotFoundError(
                "PostgreSQL's programs (initdb) are missing; Debian: apt install postgresql"
            )
        # The test's folder may be closed to the ordinary user that PostgreSQL insists on.
        self._database_folder = folder = Path(tempfile.mkdtemp(prefix="penumbra-database-"))
        service = self.services["database"]
        role = service.environment["POSTGRES_USER"]
        secret = folder / "password"
        source = self._translate(service.environment["POSTGRES_PASSWORD_FILE"], service)
        secret.write_text(Path(source).read_text())
        if self._owner:
            shutil.chown(folder, self._owner)
            shutil.chown(secret, self._owner)
        run = self._as_owner
        initdb = [
            f"--username={role}",
            f"--pwfile={secret}",
            *service.environment["POSTGRES_INITDB_ARGS"].split(),
        ]
        run("initdb", f"--pgdata={folder / 'data'}", *initdb)
        options = (
            "-D",
            str(folder / "data"),
            "-k",
            str(folder),
            "-p",
            self.ports["database"],
            "-h",
            "127.0.0.1",
        )
        server = self.make_server("database", folder, options)
        server.user = self._owner
        server.environment |= {"PGHOST": "127.0.0.1", "PGPORT": self.ports["database"]}
        server.start()
        psql = (
            "psql",
            "--quiet",
            f"--host={folder}",
            f"--port={self.ports['database']}",
            f"--username={role}",
        )
        run(*psql, "--dbname=postgres", f"--command=CREATE DATABASE {service.environment['POSTGRES_DB']}")
        for target, script in service.paths.items():
            if target.startswith("/docker-entrypoint-initdb.d/"):
                run(*psql, "--dbname=postgres", f"--command={script.read_text()}")
        server.stop()
        return server

    def _as_owner(self, program: str, *arguments: str) -> None:
        assert self._database_folder is not None
        command = [shutil.which(program, path=self._programs) or program, *arguments]
        done = subprocess.run(
            command, capture_output=True, text=True, cwd=self._database_folder, user=self._owner,
            env={"PATH": self._programs, "LANG": "C.UTF-8"},
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError(f"{program} failed\n{done.stdout}{done.stderr}")

    def _client_environment(self) -> dict[str, str]:
        """Return what the entry point of the trainer's image gives to the trainer."""
        service = self.services["trainer"]
        done = subprocess.run(
            [*self.words(service.entrypoint, service), "env"], env=self.service_environment("trainer"),
            check=True, capture_output=True, text=True,
        )  # fmt: skip
        pairs = dict(line.split("=", 1) for line in done.stdout.splitlines())
        return {name: value for name, value in pairs.items() if name.startswith(("MLFLOW_", "AWS_"))}


def _programs() -> str:
    """Return the search path: this environment's programs, PostgreSQL's, the system's."""
    servers = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda p: int(p.parent.name))
    places = [Path(sys.executable).parent, *reversed(servers)]
    return os.pathsep.join([*map(str, places), os.environ.get("PATH", "/usr/bin:/bin")])


def _ordinary_user() -> str | None:
    """Return the user that runs PostgreSQL, which refuses to be root; None for the current one."""
    if os.geteuid() != 0:
        return None
    known = {entry.pw_name for entry in pwd.getpwall()}
    return next(name for name in ("postgres", "nobody") if name in known)


def main() -> None:
    """Start the servers in the folder that the command line names, until Ctrl-C."""
    if len(sys.argv) != 2:
        sys.exit("usage: python -m tests.stack.servers FOLDER")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with Stack(Path(sys.argv[1])) as stack:
        for name, value in stack.environment.items():
            print(f"export {name}={value}")
        print(
            f"# data: {stack.bucket_url}   logs: {stack.folder}/*.log   Ctrl-C ends the servers", flush=True
        )
        with contextlib.suppress(KeyboardInterrupt):
            signal.pause()


if __name__ == "__main__":
    main()
