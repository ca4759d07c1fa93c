"""From the log of an excavator's cameras to poses with honest covariances and a trench report."""

import hashlib
import os
import sys
from pathlib import Path

__version__ = "0.1.0.dev0"


def _keep_compiled_code_apart() -> None:
    """Give numba a folder for compiled code that changes with every source file of the package.

    It keeps a function's code by the file the function stands in, and does not see that a function called from
    another file has changed: after an update the old one would go on being used.
    """
    package = Path(__file__).parent
    stamp = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        status = file.stat()
        stamp.update(f"{file.relative_to(package)} {status.st_mtime_ns} {status.st_size}\n".encode())
    home = package / "__pycache__"
    if not os.access(home if home.exists() else package, os.W_OK):
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "gradetrace"
    os.environ["NUMBA_CACHE_DIR"] = str(home / f"compiled-{stamp.hexdigest()[:12]}")
    if (config := sys.modules.get("numba.core.config")) is not None:
        config.reload_config()  # numba was there before us


if "NUMBA_CACHE_DIR" not in os.environ:
    _keep_compiled_code_apart()
