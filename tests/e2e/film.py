"""Makes an animated WebP of pictures.

    python tests/e2e/film.py --every 0.1 -o docs/images/demo.webp FOLDER

FOLDER holds PNG files, in the order of their names. The quality falls until the film fits into MAX_BYTES.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from PIL import Image

MAX_BYTES = 600_000
QUALITIES = (70, 60, 50, 40, 30, 20)


def main() -> int:
    parser = argparse.ArgumentParser(allow_abbrev=False, description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--every", type=float, required=True, metavar="S", help="time between two pictures")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    pictures = [Image.open(path).convert("RGB") for path in sorted(options.folder.glob("*.png"))]
    if not pictures:
        print(f"film: {options.folder} has no PNG files", file=sys.stderr)
        return 1
    for quality in QUALITIES:
        pictures[0].save(
            options.output,
            save_all=True,
            append_images=pictures[1:],
            duration=round(1000 * options.every),
            loop=0,
            quality=quality,
            method=6,
            minimize_size=True,
        )
        if options.output.stat().st_size <= MAX_BYTES:
            print(f"film: {len(pictures)} pictures at quality {quality}, {options.output.stat().st_size} bytes")
            return 0
    print(f"film: more than {MAX_BYTES} bytes at the lowest quality; take fewer pictures", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
