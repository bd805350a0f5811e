"""Changes of a file of tokens, each of them atomic. The file holds hashes; a token is only seen when it is made."""

import hashlib
import os
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import yaml

from fcslam.errors import ServiceError
from fcslam.service.http.authentication import Role, TokenEntry, TokensFile, read_tokens
from fcslam.storage.files import replacing, write_file

TOKEN_BYTES = 32


@dataclass(frozen=True, slots=True)
class TokenHolder:
    """Whom a new token is for."""

    name: str
    role: Role
    expires: datetime | None = None
    """When it ends, with a time zone; None: never."""


def add_token(path: Path, holder: TokenHolder, token_file: Path) -> None:
    """Make a token, write it into a private file, and its hash into the file of tokens, which is made if need be.

    Raises:
        ConfigError: the file of tokens cannot be read.
        ServiceError: there is a token of this name, or ``token_file`` is there.
        OSError: a file cannot be written.
    """
    entries = read_tokens(path) if path.exists() else ()
    if any(entry.name == holder.name for entry in entries):
        raise ServiceError(f"{path}: '{holder.name}' has a token; rotate it, or revoke it first")
    _write(path, [*entries, _made(holder, token_file, None)])


def rotate_token(path: Path, name: str, expires: datetime | None, token_file: Path) -> None:
    """Replace a token, as ``add_token`` makes it; the old one ends when the service reads the file again.

    Raises:
        ConfigError: the file of tokens cannot be read.
        ServiceError: there is no token of this name, or ``token_file`` is there and does not hold the old token.
        OSError: a file cannot be written.
    """
    entries, row = _find(path, name)
    entries[row] = _made(TokenHolder(name, entries[row].role, expires), token_file, entries[row])
    _write(path, entries)


def revoke_token(path: Path, name: str) -> None:
    """Remove a token; it ends when the service reads the file again.

    Raises:
        ConfigError: the file of tokens cannot be read.
        ServiceError: there is no token of this name.
        OSError: the file cannot be written.
    """
    entries, row = _find(path, name)
    del entries[row]
    _write(path, entries)


def _find(path: Path, name: str) -> tuple[list[TokenEntry], int]:
    entries = list(read_tokens(path))
    names = [entry.name for entry in entries]
    if name not in names:
        raise ServiceError(f"{path}: there is no token of '{name}'; there are {', '.join(names) or 'none'}")
    return entries, names.index(name)


def _made(holder: TokenHolder, token_file: Path, old: TokenEntry | None) -> TokenEntry:
    """Write a new token. The file may be there only if it holds the old one: all tokens and keys are the only copy."""
    if token_file.exists() and not (old is not None and token_file.is_file() and _hash(token_file) == old.sha256):
        raise ServiceError(f"{token_file}: exists, and would be lost; name a new file")
    token = secrets.token_urlsafe(TOKEN_BYTES)
    write_file(token_file, f"{token}\n", private=True)
    hashed = hashlib.sha256(token.encode()).hexdigest()
    return TokenEntry(name=holder.name, role=holder.role, sha256=hashed, expires=holder.expires)


def _hash(token_file: Path) -> str:
    return hashlib.sha256(token_file.read_bytes().strip()).hexdigest()


def _write(path: Path, entries: Sequence[TokenEntry]) -> None:
    """Replace the file; owner and mode stay, so that the service can still read it."""
    content = TokensFile(tokens=tuple(entries)).model_dump(mode="json", exclude_none=True)
    with replacing(path) as unfinished:
        unfinished.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
        if path.exists():
            before = path.stat()
            shutil.copymode(path, unfinished)
            os.chown(unfinished, before.st_uid, before.st_gid)
