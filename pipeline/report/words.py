"""The words of the page: one file per language in the templates, so that a translation is a file."""

from __future__ import annotations

import tomllib
from typing import Any

from pipeline.resources import template_folder


class Words:
    """Sentences by dotted key, with ``{places}`` to fill in."""

    def __init__(self, language: str = "en"):
        self.language = language
        text = (template_folder() / f"words.{language}.toml").read_text(encoding="utf-8")
        self._tree: dict[str, Any] = tomllib.loads(text)

    def __call__(self, key: str, **places: Any) -> str:
        """The sentence at `key` with its places filled. KeyError means a defect of ours."""
        node: Any = self._tree
        for part in key.split("."):
            node = node[part]
        return str(node).format(**places) if places else str(node)

    def has(self, key: str) -> bool:
        """Whether a sentence stands at `key`."""
        node: Any = self._tree
        for part in key.split("."):
            if not isinstance(node, dict) or part not in node:
                return False
            node = node[part]
        return True
