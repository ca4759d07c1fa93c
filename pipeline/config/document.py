"""TOML text -> validated models; every complaint names file, line and key."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from pipeline.config.machine import Machine
from pipeline.config.quantities import PATTERNS
from pipeline.config.site import Site
from pipeline.errors import ConfigError

MAX_BYTES = 4_000_000
Model = TypeVar("Model", bound=BaseModel)
Location = tuple[str | int, ...]


SIGNS = {"machine": "bodies", "site": "grid"}
"""Tables that only one of the two files has, and always."""


def load_machine(text: str, source: str) -> Machine:
    """The machine that a machine.toml describes; `source` is how messages call the file.

    Raises ConfigError.
    """
    return _load(text, source, Machine)


def load_site(text: str, source: str) -> Site:
    """The site that a site.toml describes; `source` is how messages call the file.

    Raises ConfigError.
    """
    return _load(text, source, Site)


def read_file(path: Path) -> bytes:
    """Bytes of a configuration file. Raises ConfigError when it cannot be read."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(
                f"{path}: larger than {MAX_BYTES // 1_000_000} MB; this is no machine or site file"
            )
        return path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None


def decode(data: bytes, source: str) -> str:
    """Text of a configuration file. Raises ConfigError when it is not UTF-8."""
    try:
        # Windows editors put a byte order mark in front, which TOML does not know.
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ConfigError(f"{source}:{line}: is not UTF-8 text; save it as UTF-8") from None


def _load(text: str, source: str, model: type[Model]) -> Model:
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{source}: not valid TOML: nested too deeply") from None
    except ValueError as error:  # also int() of thousands of digits
        where = re.search(r"\(at line (\d+), column \d+\)", str(error))
        line = f":{where.group(1)}" if where else ""
        raise ConfigError(f"{source}{line}: not valid TOML: {error}") from None
    kind, other = ("machine", "site") if model is Machine else ("site", "machine")
    if SIGNS[other] in data and SIGNS[kind] not in data:
        raise ConfigError(f"{source}: is a {other}.toml, and a {kind}.toml is needed in its place")
    try:
        # Strict, or "3" and true would pass for numbers; strict knows tuples, TOML only lists.
        return model.model_validate(_tuples(data), strict=True)
    except ValidationError as error:
        raise ConfigError(_sentences(error, data, text, source)) from None


def _tuples(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _tuples(item) for key, item in value.items()}
    if isinstance(value, list):
        return tuple(_tuples(item) for item in value)
    return value


def _sentences(error: ValidationError, data: dict[str, Any], text: str, source: str) -> str:
    """One line per key that is at fault, at most five."""
    messages: dict[Location, list[str]] = {}
    found: dict[Location, str] = {}
    for problem in error.errors(include_url=False):
        # pydantic also calls the third number of a pair of numbers missing.
        missing = problem["type"] == "missing" and isinstance(problem["loc"][-1], str)
        location = _in_file(problem["loc"], data, missing)
        message = _message(problem, missing)
        if not location and (quoted := _quoted_key(message, data)):
            location, message = quoted
        if message not in messages.setdefault(location, []):
            messages[location].append(message)
        if not missing and problem["type"] != "value_error":
            found[location] = f"; found {_short(problem['input'])}"
    lines = []
    for location, said in list(messages.items())[:5]:
        line = line_of(text, location)
        key = ".".join(str(part) for part in location)
        where = f"{source}:{line}" if line else source
        # A value that fits none of several forms brings one message for each of them.
        lines.append(f"{where}: {key + ': ' if key else ''}{' or '.join(said)}{found.get(location, '')}")
    if len(messages) > 5:
        lines.append(f"{source}: and {len(messages) - 5} more")
    return "\n".join(lines)


def _message(problem: ErrorDetails, missing: bool) -> str:
    if problem["type"] == "missing":
        return "is missing" if missing else "has too few values"
    if problem["type"] == "extra_forbidden":
        return "is not a key that is known here"
    if problem["type"] == "string_pattern_mismatch":
        return PATTERNS[problem["ctx"]["pattern"]]
    return problem["msg"].removeprefix("Value error, ").replace("Input should be", "should be")


def _in_file(location: Location, data: Any, missing: bool) -> Location:
    """The parts of pydantic's location that are keys of the file; it adds the names of types it tried."""
    kept: list[str | int] = []
    at = data
    for number, part in enumerate(location):
        known = part in at if isinstance(at, dict) else isinstance(at, list) and part in range(len(at))
        if known:
            at = at[part]
        elif not (missing and number == len(location) - 1):
            continue
        kept.append(part)
    return tuple(kept)


def _quoted_key(message: str, data: dict[str, Any]) -> tuple[Location, str] | None:
    """The key that a message of a check across tables begins with, and the rest of the message."""
    first, _, rest = message.partition(" ")
    location = tuple(first.rstrip(":").split("."))
    return (location, rest) if rest and _in_file(location, data, False) == location else None


def _short(value: object) -> str:
    shown = repr(value)
    return shown if len(shown) <= 60 else shown[:57] + "..."


def line_of(text: str, location: Location) -> int | None:
    """Line (from 1) where the deepest part of a key path stands, or of the nearest table above it."""
    wanted = [str(part) for part in location]
    best: tuple[int, int] | None = None
    table: list[str] = []
    arrays: dict[tuple[str, ...], int] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*(\[\[?)([^\[\]]+)\]\]?\s*(#.*)?$", line):
            table = []
            names = _key_parts(header.group(2))
            for depth, name in enumerate(names, 1):
                table.append(name)
                if header.group(1) == "[[" and depth == len(names):
                    arrays[tuple(table)] = arrays.get(tuple(table), -1) + 1
                if tuple(table) in arrays:
                    table.append(str(arrays[tuple(table)]))
            path = table
        elif key := re.match(r"\s*([A-Za-z0-9_.\"'-]+)\s*=", line):
            path = table + _key_parts(key.group(1))
        else:
            continue
        depth = len(path)
        if path == wanted[:depth] and (best is None or depth > best[0]):
            best = (depth, number)
    return best[1] if best else None


def _key_parts(dotted: str) -> list[str]:
    return [part.strip().strip("\"'") for part in dotted.split(".")]
