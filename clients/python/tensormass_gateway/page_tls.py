"""HTTPS of the page. Without it the page is for browsers of this machine alone."""

from __future__ import annotations

import ipaddress
import ssl
import tempfile
from pathlib import Path

from tensormass._shared.client_keys import ClientKeys


def is_loopback(host: str) -> bool:
    """Tells whether only this machine reaches an address to listen on."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name: DNS decides where it leads
        return False


def check_page(host: str, page: ClientKeys | None) -> None:
    """Raises ValueError if other machines reach the page and it has no certificate."""
    if page is None and not is_loopback(host):
        raise ValueError(
            f"--host {host}: other machines can reach this address, so the page needs a certificate. Make keys for the "
            "gateway, and start it with them:\n"
            "  tensormass keys add gateway --role operator --page HOST\n"
            "  tensormass view --keys keys/clients/gateway.json ..."
        )


def page_context(page: ClientKeys) -> ssl.SSLContext:
    """Makes the server's side of TLS 1.2 or newer, with the certificate of the page."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    # OpenSSL reads files only.
    with tempfile.NamedTemporaryFile("w", prefix="tensormass-page-") as file:
        file.write(page.page_certificate + page.page_private_key)
        file.flush()
        context.load_cert_chain(Path(file.name))
    return context
