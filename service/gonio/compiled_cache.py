"""Where numba keeps what it compiled."""

import hashlib
import os
from pathlib import Path

import platformdirs


def keep_compiled_code_apart() -> None:
    """Give numba a cache folder of its own for this exact kernel source, unless ``NUMBA_CACHE_DIR`` is set.

    Numba looks only at the file that a compiled function stands in. When a function that it calls changes in another
    file, the stale machine code is used silently: a wrong result after an upgrade, and nothing says so. One folder a
    digest of the whole kernel makes that impossible. It has to be set before numba is imported.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    digest = hashlib.sha256()
    for source in sorted((Path(__file__).parent / "kernel").rglob("*.py")):
        digest.update(source.read_bytes())
    cache = platformdirs.user_cache_path("gonio") / "compiled" / digest.hexdigest()[:16]
    os.environ["NUMBA_CACHE_DIR"] = str(cache)
