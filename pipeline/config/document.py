"""TOML text -> validated models; every complaint names file, line and key."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from pipeline.config.machine import Machine
from pipeline.config.site import Site
from pipeline.errors import ConfigError

MAX_BYTES = 4_000_000
Model = TypeVar("Model", bound=BaseModel)
Location = tuple[str | int, ...]


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


def read_text(path: Path) -> str:
    """Text of a configuration file. Raises ConfigError when it cannot be read."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ConfigError(
                f"{path}: larger than {MAX_BYTES // 1_000_000} MB; this is no machine or site file"
            )
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as UTF-8 text ({error})") from None


def _load(text: str, source: str, model: type[Model]) -> Model:
    try:
        data = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{source}: not valid TOML: {error}") from None
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ConfigError(_sentences(error, text, source)) from None


def _sentences(error: ValidationError, text: str, source: str) -> str:
    """One line per complaint, at most five."""
    problems = error.errors(include_url=False)
    lines = []
    for problem in problems[:5]:
        location = tuple(
            part for part in problem["loc"] if part not in ("moving", "joint", "static", "function-after")
        )
        line = line_of(text, location)
        key = ".".join(str(part) for part in location) or "the whole file"
        found = "" if problem["type"] in ("missing", "value_error") else f"; found {_short(problem['input'])}"
        message = problem["msg"].removeprefix("Value error, ")
        message = {"missing": "is missing", "extra_forbidden": "is not a key that is known here"}.get(
            problem["type"], message
        )
        where = f"{source}:{line}" if line else source
        lines.append(f"{where}: {key}: {message}{found}")
    if len(problems) > 5:
        lines.append(f"{source}: and {len(problems) - 5} more")
    return "\n".join(lines)


def _short(value: object) -> str:
    shown = repr(value)
    return shown if len(shown) <= 60 else shown[:57] + "..."


def line_of(text: str, location: Location) -> int | None:
    """Line (from 1) where the deepest part of a key path stands, or of the nearest table above it."""
    wanted = [str(part) for part in location]
    best: tuple[int, int] | None = None
    table: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        if header := re.match(r"\s*\[\[?([^\[\]]+)\]\]?\s*(#.*)?$", line):
            table = [part.strip().strip("\"'") for part in header.group(1).split(".")]
            path = table
        elif key := re.match(r"\s*([A-Za-z0-9_.\"'-]+)\s*=", line):
            path = table + [part.strip().strip("\"'") for part in key.group(1).split(".")]
        else:
            continue
        depth = len(path)
        if path == wanted[:depth] and (best is None or depth > best[0]):
            best = (depth, number)
    return best[1] if best else None
