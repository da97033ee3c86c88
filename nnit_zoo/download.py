"""Bring a task's zoo to this machine: from a source, or made from the GHNs that ship with nnit, with the same bytes."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection
from contextlib import suppress
from functools import partial
from io import BytesIO
from pathlib import Path

import pyarrow as pa
from huggingface_hub import is_offline_mode

from nnit_zoo import files, places
from nnit_zoo.display import Display
from nnit_zoo.errors import UserError
from nnit_zoo.files import INDEX, MANIFEST, SPLITS, Entry, Progress


class Download:
    """A zoo and the folder that it goes to, by default the task's usual one; nothing is written before `run`.

    `source` is an address as of `nnit_zoo.hub.Source`; without one, the zoo is made from the GHNs that ship. So it is
    if the Hub is not to be asked: in the usual folder, both give the same bytes. Raises UserError if there is no such
    zoo, or if a source's would take the place of this version's.
    """

    def __init__(
        self, task: str, folder: Path | None = None, *, source: str | None = None, revision: str | None = None
    ) -> None:
        self.task = task
        self.folder = places.default_folder(task) if folder is None else folder
        held = task
        with suppress(UserError):  # no zoo, or none that can be read
            held = files.Manifest.read(self.folder).task
        if held != task:
            raise UserError(f"{self.folder} holds the zoo of {held}; choose another folder for that of {task}")
        if source and not (revision or folder) and is_offline_mode():
            from nnit_zoo.hub import is_local  # noqa: PLC0415  most zoos come from no source

            source = source if is_local(source) else None
        self._verb = "fetching" if source else "making"
        self._index: pa.Table
        self._bring: Callable[[Path, Progress, Collection[str]], None]
        if source is None:
            if revision:
                raise UserError("--revision says which version of a --source: give both")
            self.manifest, self._index = places.manifest(task), places.index(task)
            self._bring = partial(_make, places.data_folder(task))
            return
        from nnit_zoo.hub import Source  # noqa: PLC0415  most zoos come from no source

        found = Source(source, task, revision)
        if folder is None and found.manifest != places.manifest(task):
            raise UserError(
                f"{source} holds another version of the zoo than this nnit; keep it elsewhere with --folder"
            )
        self.manifest, self._index, self._bring = found.manifest, files.read_index(BytesIO(found.index)), found.fetch

    @property
    def free_bytes(self) -> int:
        """Free space, in bytes, on the disk that holds the folder or would hold it."""
        existing = next(path for path in (self.folder, *self.folder.resolve().parents) if path.exists())
        return shutil.disk_usage(existing).free

    @property
    def is_there(self) -> bool:
        """Whether the folder holds this version of the zoo, whole or in part; its files are not looked at."""
        path = self.folder / MANIFEST
        return path.is_file() and path.read_bytes() == self.manifest.to_bytes()

    def wanted(self, splits: Collection[str] = SPLITS) -> set[str]:
        """The files that these splits need; raises UserError for an unknown split."""
        return files.shards_of(self._index, splits) | {INDEX}

    def missing(self, splits: Collection[str] = SPLITS) -> dict[str, Entry]:
        """Of the wanted files, those that the folder lacks or holds in another form."""
        return self.manifest.missing(self.folder, self.wanted(splits))

    def ensure(self, screen: Display) -> None:
        """`run`, with a note of what happens, unless this version of the zoo is there."""
        if not self.is_there:
            screen.note(f"{self._verb} the zoo of {self.task} in {self.folder}, as nnit-zoo download does")
            self.run(screen)

    def run(self, screen: Display, splits: Collection[str] = SPLITS) -> None:
        """Write what is missing, as `files.fill` does, and show how far it is."""
        shards = len(files.shards_of(self._index, splits))
        with screen.stage(f"{self._verb} {self.task}", shards) as progress:
            self._bring(self.folder, progress, splits)


def _make(data_folder: Path, target: Path, progress: Progress, splits: Collection[str]) -> None:
    from nnit_zoo.materialise import materialise  # noqa: PLC0415  imports torch, which a dry run does not need

    materialise(data_folder, target, progress, splits)
