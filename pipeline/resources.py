"""The files that travel with the code: schemas and page templates.

In a checkout they are the top-level folders ``schemas/`` and ``templates/``; a wheel carries them
inside the package, under ``pipeline/_data/``, because two folders of such names have no business
at the top of somebody's site-packages.
"""

from pathlib import Path

# Not importlib.resources: it would add its import to `gradetrace --help`, and buys only packages in
# zip files, where numba could not keep its cache either.
_package = Path(__file__).resolve().parent
_root = _package / "_data" if (_package / "_data").is_dir() else _package.parent


def schema_folder() -> Path:
    """The folder of schemas: ``config/``, ``channels/``, ``tables/`` and ``artefacts/``."""
    return _root / "schemas"


def schema_text(relative_path: str) -> str:
    """One schema as text, for example ``schema_text("tables/poses.json")``."""
    return (schema_folder() / relative_path).read_text(encoding="utf-8")


def template_folder() -> Path:
    """The folder of page templates and their style sheet."""
    return _root / "templates"
