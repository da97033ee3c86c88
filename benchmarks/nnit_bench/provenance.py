"""What a run was made with: code, packages and machine; imports no torch."""

from __future__ import annotations

import hashlib
import inspect
import os
import platform
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.machinery import PathFinder
from importlib.metadata import PackageNotFoundError, distributions, version
from importlib.util import find_spec
from modulefinder import ModuleFinder
from pathlib import Path
from typing import Any

from nnit_zoo.errors import UserError
from nnit_zoo.files import sha256_of
from nnit_zoo.provenance import commit

OUR_PACKAGES = ("nnit_zoo", "nnit_baselines", "nnit_bench")
"""The packages whose source files are hashed into a run's id."""
NUMERIC_PACKAGES = ("torch", "numpy", "mani_skill", "sapien")
"""The packages whose versions can change a number; the record lists all that are installed."""
FOLDER = 5
"""What `modulefinder` calls a package."""


@dataclass(frozen=True)
class Code:
    """The code that ran."""

    sha256: str
    """Of the source files of nnit_zoo, nnit_baselines and nnit_bench, and of a method given as a file."""
    commit: str | None
    """The checkout's commit."""
    dirty: bool | None
    """Whether the checkout had changes that are not in `commit`; both are null outside a checkout."""


@dataclass(frozen=True)
class Hardware:
    """The machine that ran it."""

    machine: str
    processor: str
    cores: int
    memory_gib: float


@cache
def installed_packages() -> dict[str, str]:
    """Name and version of every installed package."""
    versions = {each.metadata["Name"]: each.version for each in distributions()}
    return dict(sorted(versions.items(), key=lambda item: item[0].lower()))


def numeric_packages() -> dict[str, str]:
    """Name and version of the installed packages that can change a number."""
    found: dict[str, str] = {}
    for name in NUMERIC_PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def hash_files(files: Mapping[str, Path]) -> str:
    """SHA-256 over names and contents, in the order of the names."""
    total = hashlib.sha256()
    for name in sorted(files):
        total.update(f"{name} {sha256_of(files[name])}\n".encode())
    return total.hexdigest()


def plugin_files(module: str) -> dict[str, Path]:
    """Name -> source file of what a method in this loaded module is made of.

    A package is all its files, data too; a single file is itself and what it imports from beside it. Raises UserError
    if another method's module was loaded in place of one of these.
    """
    top = sys.modules[module.partition(".")[0]]
    if hasattr(top, "__path__"):
        roots = [Path(each) for each in top.__path__]
        found = {f"{root.name}/{path.relative_to(root)}": path for root in roots for path in root.rglob("*")}
        return {name: path for name, path in found.items() if path.is_file() and path.suffix != ".pyc"}
    file = Path(inspect.getfile(top))
    if file.parent.name in ("site-packages", "dist-packages"):  # what is beside it is not its own
        return {file.name: file}
    finder = _Finder([str(file.parent)], excludes=OUR_PACKAGES)
    finder.run_script(str(file))
    found = {name: Path(each) for name, module in finder.modules.items() if (each := vars(module)["__file__"])}
    for name, path in found.items():
        loaded = getattr(sys.modules.get(name), "__file__", None)
        if name != "__main__" and loaded is not None and Path(loaded).resolve() != path.resolve():
            raise UserError(f"{file} needs {path}, but {loaded} of that name is loaded; use a command for each of them")
    return {str(path.relative_to(file.parent)): path for path in found.values()}


class _Finder(ModuleFinder):
    """Also follows imports from a folder without `__init__.py`, which `ModuleFinder` stumbles over."""

    def find_module(self, name: str, path: Any, parent: Any = None) -> Any:
        """File, path and kind of a module; raises ImportError if there is none."""
        spec = PathFinder.find_spec(name, self.path if path is None else path)
        if spec is None or spec.origin is not None or spec.submodule_search_locations is None:
            return super().find_module(name, path, parent)
        return None, next(iter(spec.submodule_search_locations)), ("", "", FOLDER)

    def load_package(self, fqname: str, pathname: str) -> Any:
        """The package in a folder, and what it imports."""
        if (Path(pathname) / "__init__.py").is_file():
            return super().load_package(fqname, pathname)
        module: Any = self.add_module(fqname)
        module.__path__ = [pathname]
        return module


@cache  # files that change while a command runs are not what runs
def this_code(plugin: str | None = None) -> Code:
    """The code that is running, with the module of a method that is not one of ours."""
    ours = _our_code()
    if plugin is None:
        return ours
    total = hashlib.sha256(f"{ours.sha256} {hash_files(plugin_files(plugin))}".encode())
    return replace(ours, sha256=total.hexdigest())


@cache
def _our_code() -> Code:
    files: dict[str, Path] = {}
    for package in OUR_PACKAGES:
        spec = find_spec(package)
        assert spec is not None and spec.origin is not None
        root = Path(spec.origin).parent
        files |= {f"{package}/{path.relative_to(root)}": path for path in root.rglob("*.py")}
    now = commit()
    return Code(sha256=hash_files(files), commit=now.sha, dirty=now.dirty)


def this_machine() -> Hardware:
    """What this process runs on; memory in GiB."""
    processor = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        match = re.search(r"model name\s*:\s*(.+)", cpuinfo.read_text())
        processor = match.group(1) if match else processor
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return Hardware(
        machine=f"{platform.system()} {platform.machine()}",
        processor=processor,
        cores=os.cpu_count() or 1,
        memory_gib=round(memory, 1),
    )
