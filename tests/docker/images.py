"""Runs the steps of a Dockerfile in bare Debian roots, without a container engine. Needs root and mmdebstrap.

An `Image` is a folder that holds what `docker build` would put into the image, the size of each layer, and how its
program starts. A stage can be replaced by a folder that was filled otherwise, so that nothing is compiled.

Each command has mounts and processes of its own (`unshare`), which end with it. It uses the network, the proxy and the
certificates of this machine. `base` must be the only image from elsewhere that the Dockerfile names.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

# Settings with which apt and pip reach their servers.
_PASSED = re.compile(r"PIP_((EXTRA_)?INDEX_URL|TRUSTED_HOST)|(https?|no|all)_proxy", re.IGNORECASE)
# Files of this machine that commands in a root see, and where. The certificates stand apart, because the package
# ca-certificates replaces the system's list.
_SYSTEM_CERTIFICATES, _CERTIFICATES = "/etc/ssl/certs/ca-certificates.crt", "/run/certificates.crt"
_SHARED = {
    "/etc/resolv.conf": "/etc/resolv.conf",
    "/etc/pip.conf": "/etc/pip.conf",
    _SYSTEM_CERTIFICATES: _CERTIFICATES,
}
_CERTIFICATE_SETTINGS = ("PIP_CERT", "SSL_CERT_FILE", "NODE_EXTRA_CA_CERTS", "CARGO_HTTP_CAINFO")
# What the image debian:12-slim leaves out of a minimal Debian, as its dpkg settings say.
_SLIM = [f"path-exclude=/usr/share/{name}/*" for name in ("doc", "groff", "info", "linda", "lintian", "locale", "man")]
# Settings with which that image keeps apt from leaving what it downloads.
_APT_LEAVES_NOTHING = """\
DPkg::Post-Invoke { "rm -f /var/cache/apt/archives/*.deb || true"; };
Dir::Cache::pkgcache "";
Dir::Cache::srcpkgcache "";
"""
# Runs a command with the mounts of the root $1. Before `--` come pairs: a file of this machine, its place in the root.
_ENTER = r"""
set -e
root=$1
shift
mount --bind "$root" "$root"
mount -t proc proc "$root/proc"
mount --rbind --make-rslave /dev "$root/dev"
while [ "$1" != -- ]; do
  mount --bind "$1" "$root$2"
  shift 2
done
shift
exec "$@"
"""


@dataclass
class Image:
    root: Path
    environment: dict[str, str]
    folder: str = "/"
    user: str = "0"
    entrypoint: list[str] = field(default_factory=list)
    command: list[str] = field(default_factory=list)
    #: (instruction, bytes of the files that it added or changed), without the base.
    layers: list[tuple[str, int]] = field(default_factory=list)

    @property
    def size_bytes(self) -> int:
        return sum(size for _, size in self.layers)


class BuildError(Exception):
    """A step of the Dockerfile failed."""


def instructions(dockerfile: str) -> Iterator[tuple[str, str]]:
    """(instruction, its words) of each line, continued lines joined and comments dropped."""
    lines = [line for line in dockerfile.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    for line in "\n".join(lines).replace("\\\n", " ").splitlines():
        name, words = line.split(maxsplit=1)
        yield name, words


def bare_debian(folder: Path, suite: str = "bookworm") -> None:
    """Fills a folder with what debian:12-slim holds.

    Raises:
        BuildError: mmdebstrap failed, for example because there is no network.
    """
    own = Path("/etc/apt/sources.list.d/debian.sources")
    command = [
        "mmdebstrap",
        "--quiet",
        "--variant=minbase",
        *(f"--dpkgopt={option}" for option in _SLIM),
        suite,
        str(folder),
    ]
    if own.is_file() and re.search(rf"^Suites:.*\b{suite}\b", own.read_text(), re.MULTILINE):
        command.append(str(own))
    ran = subprocess.run(command, capture_output=True, text=True)
    if ran.returncode != 0:
        raise BuildError(f"mmdebstrap: {(ran.stderr.strip() or 'failed').splitlines()[-1]}")
    (folder / "etc/apt/apt.conf.d/docker-clean").write_text(_APT_LEAVES_NOTHING)


def entering(root: Path, *command: str) -> list[str]:
    """The command that runs another one with the mounts of a root."""
    shared = [words for words in _SHARED.items() if Path(words[0]).is_file()]
    for _, place in shared:
        (root / place[1:]).parent.mkdir(parents=True, exist_ok=True)
        (root / place[1:]).touch()
    enter = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", _ENTER, "enter"]
    return [*enter, str(root), *itertools.chain(*shared), "--", *command]


def starting(image: Image, *arguments: str, environment: Mapping[str, str] | None = None) -> list[str]:
    """The command that starts an image's program as its user, with a read-only root and an empty /tmp."""
    variables = {**image.environment, **(environment or {})}
    prepare = 'mount -o remount,bind,ro "$0" && mount -t tmpfs tmpfs "$0/tmp" && chmod 1777 "$0/tmp" && exec "$@"'
    drop = ["setpriv", f"--reuid={image.user}", f"--regid={image.user}", "--clear-groups", "--bounding-set=-all"]
    # The rights are dropped inside the root, because a user may not call chroot.
    inside = ["chroot", str(image.root), "/usr/bin/env", "-i", *_assignments(variables), *drop, "--no-new-privs"]
    return entering(
        image.root, "sh", "-c", prepare, str(image.root), *inside, *image.entrypoint, *(arguments or image.command)
    )


def _assignments(variables: Mapping[str, str]) -> list[str]:
    return [f"{name}={value}" for name, value in variables.items()]


class Builder:
    """Builds the stages of a Dockerfile into folders below `work`.

    `arguments` are those of `docker build --build-arg`.
    """

    def __init__(
        self,
        dockerfile: str,
        context: Path,
        work: Path,
        replaced: Mapping[str, Path],
        arguments: Mapping[str, str] | None = None,
    ) -> None:
        self._context = context
        self._arguments = arguments or {}
        self._work = work
        self._folders = dict(replaced)
        self._images: dict[str, Image] = {}
        self._stages: dict[str, list[tuple[str, str]]] = {}
        for name, words in instructions(dockerfile):
            if name == "FROM":
                self._stages[words.split(" AS ")[1]] = [(name, words)]
            else:
                next(reversed(self._stages.values())).append((name, words))
        self._base = work / "base"
        bare_debian(self._base)

    def image(self, stage: str) -> Image:
        """Returns a stage's image. Builds it, and the stages from which it copies, at the first call."""
        if stage not in self._images:
            root = self._work / stage
            subprocess.run(["cp", "-a", "--reflink=auto", self._base, root], check=True)
            image = Image(root, {"PATH": "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"})
            for name, words in self._stages[stage][1:]:
                before = _files(root)
                self._step(image, name, words)
                after = _files(root)
                added = sum(found[0] for path, found in after.items() if before.get(path) != found)
                if added:
                    image.layers.append((f"{name} {' '.join(words.split())}", added))
            self._images[stage] = image
        return self._images[stage]

    def _step(self, image: Image, name: str, words: str) -> None:
        match name:
            case "RUN":
                self._run(image, words)
            case "COPY":
                self._copy(image, words)
            case "WORKDIR":
                image.folder = words
                (image.root / words[1:]).mkdir(parents=True, exist_ok=True)
            case "ENV" | "ARG":
                given = self._arguments if name == "ARG" else {}
                for key, value in (word.split("=", 1) for word in shlex.split(words)):
                    image.environment[key] = given.get(key, value)
            case "USER":
                image.user = words
            case "ENTRYPOINT":
                image.entrypoint = json.loads(words)
            case "CMD":
                image.command = json.loads(words)
            case "STOPSIGNAL":
                assert words == "SIGTERM", "the tests end programs with SIGTERM"
            case _:
                raise BuildError(f"{name} {words}: an instruction that tests/docker/images.py does not know")

    def _run(self, image: Image, words: str) -> None:
        passed = {key: value for key, value in os.environ.items() if _PASSED.fullmatch(key)}
        if Path(_SYSTEM_CERTIFICATES).is_file():
            passed |= dict.fromkeys(_CERTIFICATE_SETTINGS, _CERTIFICATES)
        variables = {**image.environment, "DEBIAN_FRONTEND": "noninteractive", **passed}
        script = f"cd {shlex.quote(image.folder)} && {words}"
        command = ["chroot", str(image.root), "/usr/bin/env", "-i", *_assignments(variables), "/bin/sh", "-c", script]
        ran = subprocess.run(entering(image.root, *command), capture_output=True, text=True, stdin=subprocess.DEVNULL)
        if ran.returncode != 0:
            end = "\n".join((ran.stdout + ran.stderr).splitlines()[-15:])
            raise BuildError(f"RUN {words}\nended with status {ran.returncode}:\n{end}")

    def _copy(self, image: Image, words: str) -> None:
        *sources, target = words.split()
        origin = self._context
        if sources[0].startswith("--from="):
            stage = sources.pop(0).removeprefix("--from=")
            origin = self._folders[stage] if stage in self._folders else self.image(stage).root
        to = image.root / os.path.join(image.folder, target)[1:]
        for source in sources:
            found = origin / source.lstrip("/")
            if source == ".":
                for file in self._tracked():
                    (to / file).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy2(origin / file, to / file)
            elif found.is_dir():
                shutil.copytree(
                    found, to, symlinks=True, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__")
                )
            else:
                place = to / found.name if target.endswith("/") else to
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(found, place)

    def _tracked(self) -> list[str]:
        """The files that a checkout has. .dockerignore leaves out what is made from them."""
        command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        names = subprocess.run(command, cwd=self._context, check=True, capture_output=True, text=True).stdout
        return [name for name in names.split("\0") if name and (self._context / name).is_file()]


def _files(root: Path) -> dict[str, tuple[int, int]]:
    """[path]: (size, time of the last change [ns]) of every file of a root but those that are shared with it."""
    found = {}
    for folder, _, names in os.walk(root):
        for name in names:
            path = os.path.join(folder, name)
            if path.removeprefix(str(root)) not in _SHARED.values():
                about = os.lstat(path)
                found[path] = (about.st_size, about.st_mtime_ns)
    return found
