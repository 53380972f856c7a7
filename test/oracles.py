"""The wheels of scripts/setup_oracles, for tests: independent programs to compare with.

    import oracles                                   # with this folder in sys.path
    velodyne_decoder = oracles.require("velodyne_decoder")   # the module, or the test skips
    subprocess.run([oracles.python(), SCRIPT])       # the environment's own interpreter, or None

The environment is build/oracles, or where DENDRO_ORACLES points.
"""
import importlib
import os
import pathlib
import sys

ROOT = pathlib.Path(__file__).resolve().parents[1]


def folder():
    """Where the environment is, whether or not it exists."""
    build = pathlib.Path(os.environ.get("DENDRO_BUILD_DIR", ROOT / "build"))
    return pathlib.Path(os.environ.get("DENDRO_ORACLES", build / "oracles"))


def python():
    """The interpreter that has the wheels (and Debian's modules), or None."""
    interpreter = folder() / "bin/python"
    return str(interpreter) if os.access(interpreter, os.X_OK) else None


def find(name):
    """The module `name`, from the environment or the system, or None and the reason."""
    site = folder() / f"lib/python3.{sys.version_info.minor}/site-packages"
    if site.is_dir() and str(site) not in sys.path:
        sys.path.insert(0, str(site))
    try:
        return importlib.import_module(name), ""
    except ImportError as error:
        return None, f"{error}; scripts/setup_oracles installs what tests compare with"


def require(name):
    """The module `name`; skips the calling pytest when it is missing."""
    module, reason = find(name)
    if module is None:
        import pytest
        pytest.skip(reason, allow_module_level=True)
    return module
