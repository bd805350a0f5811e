"""The client certificate of a connection, passed to the application by ASGI's TLS extension."""

import asyncio
import ssl
from typing import Any

from cryptography import x509
from uvicorn.protocols.http.h11_impl import H11Protocol


class CertifiedProtocol(H11Protocol):
    """uvicorn's own, which knows the certificate and keeps it to itself.

    https://asgi.readthedocs.io/en/latest/specs/tls.html; of its entries there is only ``client_cert_name``.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """After the handshake: a client certificate, if there is one, was signed by the trusted authority."""
        super().connection_made(transport)
        tls: ssl.SSLObject | None = transport.get_extra_info("ssl_object")
        shown = None if tls is None else tls.getpeercert(binary_form=True)
        if shown is None:
            return
        name, app = x509.load_der_x509_certificate(shown).subject.rfc4514_string(), self.app

        async def with_certificate(scope: Any, receive: Any, send: Any) -> None:
            scope["extensions"] = {**scope.get("extensions", {}), "tls": {"client_cert_name": name}}
            await app(scope, receive, send)

        self.app = with_certificate
