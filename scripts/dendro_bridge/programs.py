"""Finds the package's programs, from the devel space, the install space or the build folder."""
import os
import pathlib

HERE = pathlib.Path(__file__).resolve().parent


def find_program(name):
    """Path of a program of this package.

    @raises FileNotFoundError  It is not built.
    """
    folders = [HERE.parent]  # install space: programs and scripts lie side by side
    prefixes = os.environ.get("CMAKE_PREFIX_PATH", "").split(":")
    folders += [pathlib.Path(p) / "lib" / "dendro_slam" for p in prefixes if p]
    build = os.environ.get("DENDRO_BUILD_DIR", str(HERE.parent.parent / "build"))
    folders.append(pathlib.Path(build) / "devel" / "lib" / "dendro_slam")
    for folder in folders:
        path = folder / name
        if path.is_file() and os.access(path, os.X_OK):
            return str(path)
    raise FileNotFoundError(f"the program {name} is not built: scripts/build, then "
                            "source build/devel/setup.bash")


def package_file(relative):
    """A file of the package, e.g. config/rig.yaml."""
    for root in (HERE.parent.parent, HERE.parents[2] / "share" / "dendro_slam"):
        if (root / relative).exists():
            return str(root / relative)
    return str(HERE.parent.parent / relative)
