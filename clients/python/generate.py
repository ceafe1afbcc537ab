"""Writes tensormass/v1/*_pb2.py from proto/ (not committed: the schema is the source).

The protobuf package `tensormass.v1` becomes the Python package `tensormass.v1`, so that the imports that protoc
writes are right as they stand. Runs in well under a second when nothing changed.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
PROTO_ROOT = HERE.parent.parent / "proto"
OUTPUT = HERE / "tensormass" / "v1"


def main() -> int:
    protos = sorted((PROTO_ROOT / "tensormass" / "v1").glob("*.proto"))
    marker = OUTPUT / "__init__.py"
    newest_input = max(path.stat().st_mtime for path in [*protos, Path(__file__)])
    if marker.exists() and marker.stat().st_mtime >= newest_input:
        return 0

    OUTPUT.mkdir(exist_ok=True)
    # As a program, grpc_tools.protoc adds the folder of google/protobuf/*.proto. Without it protoc looks beside the
    # interpreter, where only Debian's own Python has them.
    code = subprocess.call(
        [
            *(sys.executable, "-m", "grpc_tools.protoc"),
            f"--proto_path={PROTO_ROOT}",
            f"--python_out={HERE}",
            f"--pyi_out={HERE}",
            f"--grpc_python_out={HERE}",
            *map(str, protos),
        ]
    )
    if code == 0:
        for name in (
            "adjustment",
            "finding",
            "gateway",
            "guard",
            "recording",
            "scene",
            "solver",
            "stream",
        ):  # without services, so the stubs have no content
            (OUTPUT / f"{name}_pb2_grpc.py").unlink(missing_ok=True)
        marker.write_text('"""The protocol, generated from proto/tensormass/v1 by generate.py."""\n')
    return code


if __name__ == "__main__":
    sys.exit(main())
