"""``python -m pipeline.config.export`` writes the JSON Schemas of machine.toml and site.toml from the models.

Editors that know TOML complete and check the two files with them. They are committed, and a test holds them
against the models.
"""

from __future__ import annotations

import json
from pathlib import Path

from pydantic import BaseModel

from pipeline import resources
from pipeline.config.machine import Machine
from pipeline.config.site import Site

MODELS: dict[str, type[BaseModel]] = {"machine": Machine, "site": Site}


def schema_file(name: str) -> Path:
    """Where the exported schema of `machine` or `site` stands."""
    return resources.schema_folder() / "config" / f"{name}.schema.json"


def exported(name: str) -> str:
    """JSON Schema of `machine` or `site`, as text."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **MODELS[name].model_json_schema()}
    return json.dumps(schema, indent=1, ensure_ascii=False) + "\n"


def main() -> None:
    """Write both schemas."""
    for name in MODELS:
        path = schema_file(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(exported(name), encoding="utf-8")


if __name__ == "__main__":
    main()
