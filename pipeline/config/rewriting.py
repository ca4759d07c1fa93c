"""Calibrated values put into a TOML file that a person wrote: comments, order and every other value stay.

tomlkit keeps the text as it is; what is set is written in place of the old value, or behind the last of its table.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Comment, InlineTable, Table, Whitespace

from pipeline.errors import ConfigError

DIGITS = 10
"""Significant digits of what is written: a covariance that is rounded to fewer need not be one any more."""

DECIMALS = 6
"""A northing of seven digits is still written to a thousandth of a millimetre."""


def with_values(text: str, source: str, values: Mapping[str, Any]) -> str:
    """The text of a TOML file with some values set.

    Parameters
    ----------
    text : str
        Of the file.
    source : str
        How messages call it.
    values : mapping
        Dotted key -> value: ``{"cameras.left.mount": {"xyz_m": [...], ...}}``. A mapping replaces the whole table at
        that key, with the keys of the old one that it names again in their old order; None takes a key away. numpy
        arrays become lists. Tables on the way that do not exist are made.

    Returns
    -------
    str

    Raises
    ------
    ConfigError
        The text is no TOML, or a key on the way is no table.
    """
    try:
        document = tomlkit.parse(text)
    except (TOMLKitError, RecursionError) as error:
        raise ConfigError(f"{source}: not valid TOML: {error}") from None
    for key, value in values.items():
        *way, last = key.split(".")
        at: Any = document
        for part in way:
            if part not in at:
                at[part] = tomlkit.table(is_super_table=True)
            at = at[part]
            if not isinstance(at, Mapping):
                raise ConfigError(f"{source}: {key} cannot be set: {part} is no table")
        _put(at, last, value)
    return tomlkit.dumps(document)


def _put(table: Any, key: str, value: Any) -> None:
    if value is None:
        table.pop(key, None)
        return
    old = table.get(key)
    if isinstance(value, Mapping) and isinstance(old, Table | InlineTable):
        for gone in [name for name in old if name not in value]:
            del old[gone]
        for name, item in value.items():
            _put(old, name, item)
        return
    written = _plain(value)
    if isinstance(old, tomlkit.items.Item) and not isinstance(written, Mapping):
        # What a person wrote behind the value stays behind it.
        comment = old.trivia.comment
        table[key] = written
        if comment:
            table[key].comment(comment.lstrip("# "))
        return
    if isinstance(written, Mapping):
        inline = tomlkit.inline_table()
        inline.update(written)
        written = inline
    _append(table, key, written)


def _append(table: Any, key: str, written: Any) -> None:
    """A value at the end of what stands in its table: before blank lines and comments, which announce the next one."""
    announcing = []
    if key not in table and isinstance(table, Table):
        body = table.value.body
        while body and body[-1][0] is None:
            announcing.append(body.pop()[1])
    table[key] = written
    for item in reversed(announcing):
        if isinstance(item, Comment | Whitespace):  # else what a deleted key left
            table.add(item)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items() if item is not None}
    if isinstance(value, datetime.date | str | bool | int):
        return value
    if isinstance(value, Sequence):
        return [_plain(item) for item in value]
    value = float(value)
    whole = len(str(int(abs(value)))) if np.isfinite(value) else 0
    return float(f"{value:.{max(DIGITS, whole + DECIMALS)}g}")
