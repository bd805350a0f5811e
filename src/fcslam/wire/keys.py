"""TLS keys: an encrypted key is an error instead of a prompt on a terminal."""

import ssl


def no_passphrase() -> str:
    """Password callback for ``load_cert_chain``, so that OpenSSL does not ask on the terminal.

    Raises:
        ssl.SSLError: always; OpenSSL calls it only for an encrypted key.
    """
    raise ssl.SSLError("the key is encrypted; give one without a passphrase: openssl pkey -in KEY -out KEY2")
