"""Development credentials: a certificate authority, the cloud's certificate, tokens. Keys never leave the folder.

ca.pem, ca.key          the authority; robots and viewers get ca.pem
cloud.pem, cloud.key    the cloud's certificate
tokens.yaml             name, role and SHA-256 of every token: for the cloud
robots/<name>/          what a robot gets: ca.pem, its token, and a certificate that a service may take instead
users/<name>/           what a viewer or admin gets: ca.pem and a token
cluster/                an authority of its own, and the certificate of a cluster's scheduler, workers and clients
"""

import datetime
import hashlib
import ipaddress
import os
import secrets
import shutil
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fcslam.errors import InputError
from fcslam.service.authentication import Role, TokenEntry, TokensFile, read_tokens
from fcslam.storage.files import write_file
from fcslam.wire.keys import AUTHORITY, CERTIFICATE, TOKEN

AUTHORITY_DAYS, LEAF_DAYS = 3650, 397
"""Longest validity of a server certificate that clients accept."""

_USAGES = (
    "digital_signature",
    "content_commitment",
    "key_encipherment",
    "data_encipherment",
    "key_agreement",
    "key_cert_sign",
    "crl_sign",
    "encipher_only",
    "decipher_only",
)

Authority = tuple[x509.Certificate, ec.EllipticCurvePrivateKey]


def make_credentials(folder: Path, hosts: Sequence[str], names: Mapping[str, Role], now: datetime.datetime) -> None:
    """Make what is missing: the authority and tokens that are there stay; certificates of the robots in ``names``, and
    with ``hosts`` that of the cloud, are replaced.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        authority = _authority(folder, now)
        served = [_host(host) for host in dict.fromkeys([*hosts, "localhost", "127.0.0.1", "::1"])]
        if hosts or not (folder / "cloud.pem").exists():
            _make_leaf(folder / "cloud", "fcslam cloud", [ExtendedKeyUsageOID.SERVER_AUTH], served, authority, now)
        for name, role in names.items():
            own = folder_of(folder, name, role)
            own.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(folder / "ca.pem", own / AUTHORITY)
            if role is Role.ROBOT:
                _make_leaf(own / Path(CERTIFICATE).stem, name, [ExtendedKeyUsageOID.CLIENT_AUTH], (), authority, now)
        _add_tokens(folder, names)
    except (OSError, ValueError) as error:
        raise InputError(f"{folder}: cannot write credentials ({error}); name a new folder") from error


def folder_of(folder: Path, name: str, role: Role) -> Path:
    """What a robot or a user gets of a folder of credentials."""
    return folder / ("robots" if role is Role.ROBOT else "users") / name


def make_cluster_credentials(folder: Path, now: datetime.datetime) -> None:
    """Make what a cluster needs for TLS, in the folder ``cluster``; its authority stays if it is there.

    Whoever has a certificate of this authority can run programs on the whole cluster, so it signs no robot's.
    """
    cluster = folder / "cluster"
    try:
        cluster.mkdir(parents=True, exist_ok=True)
        purposes = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        _make_leaf(cluster / "member", "fcslam cluster", purposes, (), _authority(cluster, now), now)
    except (OSError, ValueError) as error:
        raise InputError(f"{cluster}: cannot write credentials ({error}); name a new folder") from error


def _authority(folder: Path, now: datetime.datetime) -> Authority:
    if (folder / "ca.key").exists():
        found = serialization.load_pem_private_key((folder / "ca.key").read_bytes(), None)
        if not isinstance(found, ec.EllipticCurvePrivateKey):
            raise ValueError("ca.key is not a key of ours")
        return x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes()), found
    return _issue(folder / "ca", "fcslam development authority", now)


def _make_leaf(
    stem: Path,
    name: str,
    purposes: Sequence[x509.ObjectIdentifier],
    hosts: Sequence[x509.GeneralName],
    authority: Authority,
    now: datetime.datetime,
) -> None:
    """A certificate of the authority's, good for these purposes; that of a host names it."""
    more: list[x509.ExtensionType] = [x509.ExtendedKeyUsage(purposes)]
    more += [x509.SubjectAlternativeName(hosts)] if hosts else []
    more.append(x509.AuthorityKeyIdentifier.from_issuer_public_key(authority[1].public_key()))
    _issue(stem, name, now, authority, more)


def _issue(
    stem: Path,
    name: str,
    now: datetime.datetime,
    authority: Authority | None = None,
    more: Sequence[x509.ExtensionType] = (),
) -> Authority:
    """Write a certificate and its key: of an authority, or signed by one and with more extensions."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    issuer, signer = (subject, key) if authority is None else (authority[0].subject, authority[1])
    days = AUTHORITY_DAYS if authority is None else LEAF_DAYS
    builder = x509.CertificateBuilder(issuer, subject, key.public_key(), x509.random_serial_number())
    # clocks of robots may be behind
    builder = builder.not_valid_before(now - datetime.timedelta(days=1))
    builder = builder.not_valid_after(now + datetime.timedelta(days=days))
    builder = builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    limits = x509.BasicConstraints(ca=authority is None, path_length=0 if authority is None else None)
    allowed = dict.fromkeys(("key_cert_sign", "crl_sign") if authority is None else ("digital_signature",), True)
    usage = x509.KeyUsage(**dict.fromkeys(_USAGES, False) | allowed)
    builder = builder.add_extension(limits, critical=True).add_extension(usage, critical=True)
    for extension in more:
        builder = builder.add_extension(extension, critical=False)
    certificate = builder.sign(signer, hashes.SHA256())
    form, encryption = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    secret = key.private_bytes(serialization.Encoding.PEM, form, encryption)
    write_file(stem.with_name(f"{stem.name}.key"), secret, private=True)
    write_file(stem.with_name(f"{stem.name}.pem"), certificate.public_bytes(serialization.Encoding.PEM))
    return certificate, key


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _add_tokens(folder: Path, names: Mapping[str, Role]) -> None:
    path = folder / "tokens.yaml"
    entries = list(read_tokens(path)) if path.exists() else []
    known = {entry.name for entry in entries}
    for name, role in names.items():
        if name not in known:
            token = secrets.token_urlsafe()
            place = folder_of(folder, name, role) / TOKEN
            if place.exists():
                raise InputError(f"{place}: tokens.yaml has no entry for this token; remove it, and a new one is made")
            write_file(place, f"{token}\n", private=True)
            entries.append(TokenEntry(name=name, role=role, sha256=hashlib.sha256(token.encode()).hexdigest()))
    if len(entries) == len(known):
        return
    content = TokensFile(tokens=tuple(entries)).model_dump(mode="json", exclude_none=True)
    before = path.stat() if path.exists() else None
    write_file(path, yaml.safe_dump(content, sort_keys=False))
    if before is not None:  # the service still reads it if another user runs this
        path.chmod(stat.S_IMODE(before.st_mode))
        os.chown(path, before.st_uid, before.st_gid)
