"""Files with a secret: read only if not every user of this machine can use them."""

from __future__ import annotations

import os
from pathlib import Path

from tensormass._shared.errors import InvalidArgumentError

_OTHERS = 0o007


def read_secret(path: Path, name: str, missing: str, exposed: str) -> str:
    """Reads a text that users other than the file's owner and group may not know.

    The owner must be this process's effective user or root. Whoever owns a file can read and replace it, whatever its
    mode. Kubernetes' Secrets are root's.

    Args:
        name: how refusals name the file.
        missing: ends the refusal of a file that cannot be read, as `; get another`, or is empty.
        exposed: goes before `chmod o-rwx` in the refusal of a file that others can use, or is empty.

    Raises:
        InvalidArgumentError: it cannot be read, is not text, belongs to somebody else, or every user of this machine
            can use it.
    """
    try:
        with path.open("rb") as file:
            # The mode of what is read counts, whatever has its name by now.
            found, user = os.fstat(file.fileno()), os.geteuid()
            if found.st_mode & _OTHERS:
                raise InvalidArgumentError(
                    f"{name}: every user of this machine can use it; {exposed}chmod o-rwx {path}"
                )
            if found.st_uid not in (user, 0):
                raise InvalidArgumentError(
                    f"{name}: user {found.st_uid} owns it, who is neither the user of this program, {user}, nor root; "
                    f"run it as user {found.st_uid}, or: chown {user} {path}"
                )
            return file.read().decode()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not text"
        raise InvalidArgumentError(f"{name}: cannot be read: {reason}{missing}") from error
