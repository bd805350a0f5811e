"""Keys of TLS: one that is encrypted is an error here, and not a prompt that nobody sees."""

import ssl


def no_passphrase() -> str:
    """To be given to ``load_cert_chain`` as its password, lest OpenSSL ask a terminal.

    Raises:
        ssl.SSLError: always, as it is called only where a key is encrypted.
    """
    raise ssl.SSLError("the key is encrypted; give one without a passphrase: openssl pkey -in KEY -out KEY2")
