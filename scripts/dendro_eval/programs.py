"""Where the package's programs are."""

import os
import shutil

from .errors import InputError


def program(name):
    """Path of one of the package's programs: the build beside this script, else PATH."""
    root = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    build = os.environ.get("DENDRO_BUILD_DIR") or os.path.join(root, "build")
    for path in (os.path.join(build, "devel", "lib", "dendro_slam", name), os.path.join(root, name)):
        if os.access(path, os.X_OK):
            return path
    found = shutil.which(name)
    if found is None:
        raise InputError(f"the program {name} is not built: run scripts/build {name}")
    return found
