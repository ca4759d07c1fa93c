"""The tags of both files together: each is one of a kind."""

from __future__ import annotations

from pipeline.config.machine import Machine
from pipeline.config.site import Site
from pipeline.errors import ConfigError


def described_tags(machine: Machine, site: Site) -> dict[tuple[str, int], str]:
    """Family and id of every tag, and the marker or benchmark it stands on. Raises ConfigError."""
    owner: dict[tuple[str, int], str] = {}
    for name, marker in [*machine.markers.items(), *site.benchmarks.items()]:
        for tag in marker.tags:
            other = owner.setdefault((marker.family, tag.id), name)
            if other != name:
                raise ConfigError(
                    f"tag {tag.id} of {marker.family} stands on both '{other}' and '{name}', of which machine.toml and "
                    "site.toml tell: correct the id of one of them; if both prints are the same, replace one of them"
                )
    return owner
