"""The run folder of one log: content hashes, fingerprints, manifests, the lock, whole files or none.

What is stale is decided by a fingerprint over content, never by a file's name or date. A kill at any
moment leaves whole files only: everything is written under a temporary name in the same folder,
flushed to the disk and renamed, and a stage's manifest comes last.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import math
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from pipeline.errors import ArtefactError

PARTIAL = ".partial"
"""Ending of a file that is being written; what a kill left of them is removed at the next start."""
ALWAYS_HASHED_BYTES = 32_000_000
"""Files up to this size are hashed each time they are asked for: 20 ms, less than trusting a date is worth."""
NEVER_RUN = "never run"
"""Why a stage without a manifest is stale."""

_NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write into that appears under `path` whole, on leaving the block, or not at all.

    Raises ArtefactError when the disk is full or the folder cannot be written to.
    """
    path = Path(path)
    # The process id keeps two worker processes that do the same piece out of each other's file.
    partial = path.with_name(f".{path.name}.{os.getpid()}{PARTIAL}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(path)
        _sync_folder(path.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise _storage_error(path, error) from error
        raise


def atomic_write(path: Path, data: bytes) -> None:
    """Write `data` to `path`, whole or not at all. Raises ArtefactError as `atomic_file` does."""
    with atomic_file(path) as stream:
        stream.write(data)


def _sync_folder(folder: Path) -> None:
    # The rename itself lives in the folder: without this a power cut may bring the old name back.
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:  # some network file systems have no fsync of folders
        pass
    finally:
        os.close(descriptor)


def _storage_error(path: Path, error: OSError) -> ArtefactError:
    if error.errno in _NO_SPACE:
        return ArtefactError(
            f"the disk is full: {path} could not be written; free some space, or name a folder on "
            "another disk, and run the same command again (nothing half-written was left behind)"
        )
    reason = error.strerror or str(error)
    return ArtefactError(
        f"{path} cannot be written ({reason}); make its folder writable, or name another one"
    )


def json_bytes(value: Any) -> bytes:
    """`value` as JSON text: same bytes for the same content, NaN and infinity as null, numpy as plain numbers."""
    text = json.dumps(_plain(value), indent=1, ensure_ascii=False, allow_nan=False)
    return text.encode("utf-8") + b"\n"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):  # numpy arrays and scalars, without importing numpy here
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def sha256_of(value: Any) -> str:
    """sha256 of a JSON-like value, independent of the order of its keys."""
    text = json.dumps(_plain(value), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()


def sha256_of_file(path: Path, watch: Callable[[int], None] | None = None) -> str:
    """sha256 of a file's content; `watch` is told the bytes of each portion. Raises OSError."""
    digest = hashlib.sha256()
    with path.open("rb", buffering=0) as stream:
        while portion := stream.read(1 << 22):
            digest.update(portion)
            if watch is not None:
                watch(len(portion))
    return digest.hexdigest()


@dataclass(frozen=True)
class Manifest:
    """What a finished stage says of itself; written last, so that it vouches for its outputs."""

    stage: str
    version: int
    fingerprint: str
    inputs: dict[str, str]
    """Name of the input -> sha256 of its content."""
    settings: dict[str, Any]
    schemas: dict[str, int]
    """Table -> version of its schema."""
    outputs: dict[str, str]
    """File, relative to the run folder -> sha256."""
    counts: dict[str, Any]
    warnings: list[str] = field(default_factory=list)
    seconds: float = 0.0
    finished_utc: str = ""


def fingerprint(
    version: int, inputs: dict[str, str], settings: dict[str, Any], schemas: dict[str, int]
) -> str:
    """What a stage's result depends on, as one sha256."""
    return sha256_of({"version": version, "inputs": inputs, "settings": settings, "schemas": schemas})


class RunFolder:
    """The folder of one log's artefacts."""

    def __init__(self, path: Path):
        self.path = Path(path)

    def file(self, relative: str) -> Path:
        return self.path / relative

    def create(self) -> None:
        """Make the folder. Raises ArtefactError."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _storage_error(self.path, error) from error

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder for this process, and clear away what a killed one left half-written.

        Raises ArtefactError when another process holds it. The lock dies with its process, so a kill leaves none.
        """
        self.create()
        lock = self.file(".lock")
        try:
            stream = lock.open("a+")
        except OSError as error:
            raise _storage_error(lock, error) from error
        with stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                stream.seek(0)
                holder = stream.read(20).strip() or "unknown"
                raise ArtefactError(
                    f"{self.path} is in use by another gradetrace (process {holder}); wait until it has "
                    "finished, or give --runs another folder"
                ) from None
            with contextlib.suppress(OSError):  # the number only helps a reader; a full disk is met later
                stream.truncate(0)
                stream.write(f"{os.getpid()}\n")
                stream.flush()
            for leftover in self.path.rglob(f".*{PARTIAL}"):
                leftover.unlink(missing_ok=True)
            yield

    def manifest(self, stage: str) -> Manifest | None:
        """The manifest of a stage, or None where there is none that can be read."""
        try:
            return Manifest(**json.loads(self.file(f"{stage}.manifest.json").read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def write_manifest(self, manifest: Manifest) -> None:
        atomic_write(self.file(f"{manifest.stage}.manifest.json"), json_bytes(asdict(manifest)))

    def withdraw(self, stage: str) -> None:
        """Remove a stage's manifest: from now on its outputs vouch for nothing."""
        self.file(f"{stage}.manifest.json").unlink(missing_ok=True)

    def remove(self, files: list[str]) -> None:
        """Remove outputs that a stage no longer makes, and the folders that this leaves empty."""
        for relative in files:
            path = self.file(relative)
            path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                if path.parent != self.path:
                    path.parent.rmdir()

    def scratch(self, stage: str, fingerprint: str) -> Path:
        """A folder for finished pieces of a stage, found again after a kill only under the same fingerprint."""
        path = self.file(f".{stage}-{fingerprint[:16]}")
        for other in self.path.glob(f".{stage}-*"):
            if other != path:
                shutil.rmtree(other, ignore_errors=True)
        try:
            path.mkdir(exist_ok=True)
        except OSError as error:
            raise _storage_error(path, error) from error
        return path

    def clear_scratch(self, stage: str) -> None:
        for path in self.path.glob(f".{stage}-*"):
            shutil.rmtree(path, ignore_errors=True)

    def why_stale(
        self,
        stage: str,
        version: int,
        inputs: dict[str, str],
        settings: dict[str, Any],
        schemas: dict[str, int],
    ) -> str | None:
        """Why a stage must run, as a few words, or None where its outputs stand for these inputs and settings."""
        manifest = self.manifest(stage)
        if manifest is None:
            return NEVER_RUN
        if manifest.version != version:
            return "made by another version of the stage"
        if manifest.schemas != schemas:
            return "made with another version of the table schemas"
        if changed := _first_difference(manifest.inputs, inputs):
            return f"{changed} changed"
        if changed := _first_difference(manifest.settings, _plain(settings)):
            return f"{changed} changed"
        if manifest.fingerprint != fingerprint(version, inputs, settings, schemas):
            return "its manifest does not fit its fingerprint"
        for relative, expected in manifest.outputs.items():
            try:
                found = self.hash_file(self.file(relative))
            except OSError:
                return f"{relative} is missing"
            if found != expected:
                return f"{relative} is not what the stage wrote"
        return None

    def hash_file(self, path: Path, watch: Callable[[int], None] | None = None) -> str:
        """sha256 of a file's content. Raises OSError.

        A shift's log takes a minute to hash, so the hash of a large file is kept in the run folder beside the
        identity of the file it was taken from (device, inode, size, both times to the nanosecond). That is a cache of
        the hash and decides nothing else: `touch` costs one more hashing, and a fingerprint only ever sees content.
        """
        stat = path.stat()
        if stat.st_size <= ALWAYS_HASHED_BYTES:
            return sha256_of_file(path, watch)
        identity = [stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]
        cache_file, key = self.file(".hashes.json"), str(path.resolve())
        try:
            cache = json.loads(cache_file.read_text(encoding="utf-8"))
            if cache[key]["identity"] == identity:
                return str(cache[key]["sha256"])
        except (OSError, ValueError, KeyError, TypeError):
            cache = {}
        found = sha256_of_file(path, watch)
        if not isinstance(cache, dict):
            cache = {}
        cache[key] = {"identity": identity, "sha256": found}
        if self.path.is_dir():
            atomic_write(cache_file, json_bytes(cache))
        return found


def _first_difference(old: Any, new: Any, name: str = "") -> str:
    """Dotted name of the first entry in which two JSON-like values differ, or an empty string."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*new, *(key for key in old if key not in new)]:
            if key not in old or key not in new:
                return f"{name}{key}"
            if found := _first_difference(old[key], new[key], f"{name}{key}."):
                return found
        return ""
    return "" if old == new else name.rstrip(".")
