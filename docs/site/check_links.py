"""Checks a built site: every link and picture leads to a file of the site, and every anchor to an element there.

    python docs/site/check_links.py build/docs/html

Addresses on the web are not opened. Prints one line a broken link and ends with 1 if there is any.
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ADDRESSES = {"a": "href", "img": "src", "link": "href", "script": "src", "source": "srcset"}


class Page(HTMLParser):
    """Collects the addresses of a page and what an anchor may name."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        self.anchors |= {value for key in ("id", "name") if (value := named.get(key))}
        address = named.get(ADDRESSES.get(tag, ""))
        if address:
            self.addresses.append(address)


def broken_links(site: Path) -> list[str]:
    """Returns a line for each address that leads nowhere."""
    site = site.resolve()
    pages = {path: Page(path) for path in sorted(site.rglob("*.html")) if "_static" not in path.parts}
    if not pages:
        return [f"{site}: there is no page; run `make docs`"]
    problems = []
    for path, page in pages.items():
        for address in page.addresses:
            parts = urlsplit(address)
            # The top of a page and the place that a script fills in are on every page.
            if parts.scheme or parts.netloc or address == "#":
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchor = unquote(parts.fragment)
            if not target.is_file() or not target.is_relative_to(site):
                problems.append(f"{path.relative_to(site)}: {address} leads to no file of the site")
            elif anchor and target in pages and anchor not in pages[target].anchors:
                problems.append(f"{path.relative_to(site)}: {address} names an anchor that is not there")
    return problems


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__)
        return 2
    problems = broken_links(Path(sys.argv[1]))
    print("\n".join(problems), end="\n" if problems else "", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
