# SPDX-License-Identifier: Apache-2.0
"""CURVE keys in files: one pair of the appliance, one of every client, and the folder of clients that are allowed.

Files are ZeroMQ certificates (ZPL: ``public-key = "..."``, 40 characters of Z85), which ``zmq.auth`` and czmq read.
Secrets are readable by their owner alone, from the first byte on, and are refused when they are not.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from edge.errors import ConfigError, RfconstructError

DEFAULT_FOLDER = Path("/var/lib/rfconstruct/keys")
SERVER, CLIENTS = "server", "clients"
PUBLIC, SECRET = ".key", ".key_secret"
CLIENT_LIMIT = 256
FILE_LIMIT_BYTES = 4096
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_LINE = re.compile(r'\s*(public-key|secret-key|server-key)\s*=\s*"([^"\s]*)"\s*')
_Z85 = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")


@dataclass(frozen=True, slots=True)
class Certificate:
    """The keys of one file, each 40 bytes of Z85, or empty when the file does not have it.

    Args:
        public, secret: of its owner.
        server: public key of the appliance, in the file of a client.
    """

    public: bytes
    secret: bytes = b""
    server: bytes = b""

    def __repr__(self) -> str:
        return f"Certificate(public={self.public!r})"


class KeyFolder:
    """The appliance's keys: ``server.key``, ``server.key_secret`` and ``clients/NAME.key``.

    Args:
        path: folder; ``create`` makes it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.clients = path / CLIENTS

    def create(self) -> Certificate:
        """Make the folder and the appliance's pair; ConfigError when there is a pair, which is never overwritten."""
        for folder in (self.path, self.clients):
            _make_folder(folder)
        pair = _new_pair()
        _write(self.path / f"{SERVER}{SECRET}", pair, 0o600)
        (self.path / f"{SERVER}{PUBLIC}").unlink(missing_ok=True)
        _write(self.path / f"{SERVER}{PUBLIC}", Certificate(pair.public), 0o644)
        return Certificate(pair.public)

    def server(self) -> Certificate:
        """The appliance's pair; ConfigError when it is absent, damaged or readable by others."""
        problem = next(self._folder_problems(), None)
        if problem is not None:
            raise ConfigError(problem, action="rfconstruct keys list shows what else is wrong")
        return read_secret(self.path / f"{SERVER}{SECRET}")

    def allow(self, name: str, public: bytes) -> None:
        """Let a client in from its next connection on; ConfigError: no name, no key, or the name is taken."""
        _make_folder(self.clients)
        if len(self.names()) >= CLIENT_LIMIT:
            raise ConfigError("too many clients", value=len(self.names()), allowed=f"up to {CLIENT_LIMIT}")
        _write(self.clients / f"{checked_name(name)}{PUBLIC}", Certificate(_checked_key(public, name)), 0o644)

    def revoke(self, name: str) -> None:
        """Refuse a client from its next connection on; ConfigError when it is not among the allowed."""
        try:
            (self.clients / f"{checked_name(name)}{PUBLIC}").unlink()
        except FileNotFoundError as error:
            raise ConfigError(
                "no such client", value=name, allowed=", ".join(self.names()) or "none is allowed"
            ) from error

    def names(self) -> list[str]:
        """Names of the clients that are allowed."""
        return sorted(path.name.removesuffix(PUBLIC) for path in self.clients.glob(f"*{PUBLIC}"))

    def allowed(self) -> dict[bytes, str]:
        """Public key -> name of every client that is allowed; a damaged file lets nobody in and is left out."""
        found = {}
        for name in self.names()[:CLIENT_LIMIT]:
            try:
                found[read_certificate(self.clients / f"{name}{PUBLIC}").public] = name
            except RfconstructError:
                continue
        return found

    def problems(self) -> Iterator[str]:
        """What is wrong with files and modes, in words; nothing when all is well."""
        yield from self._folder_problems()
        if self.path.is_dir():
            yield from self._pair_problems()
        for path in self._client_files():
            try:
                read_certificate(path)
            except RfconstructError as error:
                yield error.what

    def _pair_problems(self) -> Iterator[str]:
        """The secret is closed, the service's own, and of one pair with both public keys."""
        secret_path, public_path = self.path / f"{SERVER}{SECRET}", self.path / f"{SERVER}{PUBLIC}"
        try:
            pair = read_secret(secret_path)
        except RfconstructError as error:
            yield error.what
            return
        if secret_path.stat().st_uid != self.path.stat().st_uid:
            yield f"keys: {secret_path} belongs to another user than its folder (id {secret_path.stat().st_uid})"
        if _public_of(pair.secret) != pair.public:
            yield f"keys: secret and public key in {secret_path} are no pair"
        try:
            if read_certificate(public_path).public != pair.public:
                yield f"keys: {public_path} is not the public key of {secret_path}: clients that have it are lost"
        except RfconstructError as error:
            yield error.what

    def _folder_problems(self) -> Iterator[str]:
        """Whoever may write here decides who is let in."""
        for folder in (self.path, self.clients):
            if not folder.is_dir():
                yield f"keys: no folder {folder}"
            elif folder.stat().st_mode & 0o077:
                yield f"keys: folder {folder} is open to others (mode {_mode(folder)}, should be 0700)"
            elif os.geteuid() and folder.stat().st_uid not in (0, os.geteuid()):
                yield f"keys: folder {folder} belongs to another user (id {folder.stat().st_uid})"

    def _client_files(self) -> list[Path]:
        return [self.clients / f"{name}{PUBLIC}" for name in self.names()]


def create_client(name: str, out: Path, server_public: bytes) -> Certificate:
    """A client's pair in two files: ``NAME.key_secret``, with the appliance's key, and ``NAME.key`` to be allowed.

    Args:
        name: of the client.
        out: folder.
        server_public: the appliance's public key.
    Returns:
        The public part.
    Raises:
        ConfigError: the name is none, a file exists, or the folder cannot be written.
    """
    pair = _new_pair()
    _write(
        out / f"{checked_name(name)}{SECRET}",
        Certificate(pair.public, pair.secret, _checked_key(server_public, name)),
        0o600,
    )
    _write(out / f"{name}{PUBLIC}", Certificate(pair.public), 0o644)
    return Certificate(pair.public)


def read_secret(path: Path) -> Certificate:
    """A pair; ConfigError when others may read the file or it holds no secret key."""
    certificate = read_certificate(path)
    if path.stat().st_mode & 0o077:
        raise ConfigError(
            f"keys: {path} is open to others (mode {_mode(path)})",
            allowed="0600",
            action=f"make new keys, or if nobody can have read it: chmod 600 {path}",
        )
    if not certificate.secret:
        raise ConfigError(f"keys: {path} holds no secret key", allowed=f"a *{SECRET} file")
    return certificate


def read_certificate(path: Path) -> Certificate:
    """The keys of a file; ConfigError when it cannot be read or holds no valid public key."""
    try:
        with path.open("rb") as file:
            text = file.read(FILE_LIMIT_BYTES + 1).decode("ascii")
    except (OSError, UnicodeDecodeError) as error:
        absent = isinstance(error, FileNotFoundError)
        raise ConfigError(
            f"keys: {path} {'does not exist' if absent else 'cannot be read'}",
            value=None if absent else getattr(error, "strerror", None) or str(error),
            action="rfconstruct keys makes keys: init those of the appliance, client those of a subscriber"
            if absent
            else "read it as the user to whom it belongs",
        ) from error
    found: dict[str, bytes] = {}
    for match in filter(None, map(_LINE.fullmatch, text.splitlines())):
        if match[1] in found:
            raise ConfigError(f"keys: {path} has {match[1]} twice")
        found[match[1]] = _checked_key(match[2].encode("ascii"), str(path))
    if "public-key" not in found or len(text) > FILE_LIMIT_BYTES:
        raise ConfigError(f"keys: {path} is no key file", allowed='public-key = "40 characters of Z85"')
    return Certificate(found["public-key"], found.get("secret-key", b""), found.get("server-key", b""))


def checked_name(name: str) -> str:
    """A name that may become a file name; ConfigError when it may not."""
    if not _NAME.fullmatch(name) or name == SERVER:
        raise ConfigError("not a name for a client", value=name, allowed="letters, digits, . _ -; up to 64")
    return name


def _checked_key(key: bytes, owner: str) -> bytes:
    if not _Z85.fullmatch(key.decode("ascii", "replace")):
        raise ConfigError(f"keys: no CURVE key in {owner}", allowed="40 characters of Z85")
    return key


def _new_pair() -> Certificate:
    import zmq  # keys are read without it

    return Certificate(*zmq.curve_keypair())


def _public_of(secret: bytes) -> bytes:
    import zmq

    return bytes(zmq.curve_public(secret))


def _make_folder(folder: Path) -> None:
    """A folder for its owner alone; it belongs to whom the folder above belongs."""
    if folder.is_dir():
        return
    try:
        folder.mkdir(mode=0o700)
        folder.chmod(0o700)
        _inherit_owner(folder)
    except OSError as error:
        raise ConfigError(f"keys: folder cannot be made ({error.strerror})", value=str(folder)) from error


def _write(path: Path, certificate: Certificate, mode: int) -> None:
    """A new file that has its mode before it has its content; nothing is overwritten or followed."""
    lines = ["# RFconstruct CURVE key", "curve", f'    public-key = "{certificate.public.decode()}"']
    if certificate.secret:
        lines.append(f'    secret-key = "{certificate.secret.decode()}"')
    if certificate.server:
        lines.append(f'    server-key = "{certificate.server.decode()}"')
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, mode)
        with os.fdopen(handle, "w", encoding="ascii") as file:
            os.fchmod(handle, mode)
            file.write("\n".join(lines) + "\n")
            file.flush()
            os.fsync(handle)
        _inherit_owner(path)
    except FileExistsError as error:
        raise ConfigError("keys: the file exists", value=str(path), action="revoke or remove it first") from error
    except OSError as error:
        raise ConfigError(f"keys: file cannot be written ({error.strerror})", value=str(path)) from error


def _inherit_owner(path: Path) -> None:
    """Made by root for the service: what lies in the service's folder belongs to the service."""
    if os.geteuid() == 0:
        above = path.parent.stat()
        os.chown(path, above.st_uid, above.st_gid, follow_symlinks=False)


def _mode(path: Path) -> str:
    return f"{stat.S_IMODE(path.stat().st_mode):04o}"
