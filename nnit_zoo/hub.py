"""Zoos elsewhere: read from a data set of the Hugging Face Hub or from a folder laid out like one, and pushed there.

A source holds `<task>/manifest.json` with the task's index and shards beside it, or these files at its root.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path, PurePosixPath

import httpx2
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, HfFileSystem
from huggingface_hub.constants import ENDPOINT
from huggingface_hub.errors import EntryNotFoundError, HfHubHTTPError, LocalTokenNotFoundError, OfflineModeIsEnabled
from pydantic import ValidationError

from nnit_zoo import files
from nnit_zoo.errors import UserError
from nnit_zoo.files import INDEX, MANIFEST, Entry, Manifest, Progress

_CONNECTIONS = 8
_PREFIXES = (f"{ENDPOINT}/datasets/", "hf://datasets/", "hf://", "datasets/")
"""What may precede owner/name in the address of a data set."""
_PASSING = (408, 409, 412, 429, 500, 502, 503, 504)
"""Statuses of a Hub that may answer otherwise the next time; 412: somebody else has pushed meanwhile."""


class Source:
    """The zoo of a task at an address: a folder, or a data set of the Hub.

    A data set is `owner/name`, `hf://datasets/owner/name`, or the address of its page. `revision` is a branch, tag or
    commit of it. Raises UserError if there is no such place or no zoo in it.
    """

    def __init__(self, address: str, task: str, revision: str | None = None) -> None:
        self.address = f"{address}@{revision}" if revision else address
        self._revision = revision
        self._hub: HfFileSystem | None = None
        if is_local(address):
            root = address
            if not Path(address).is_dir():
                raise UserError(f"no folder {address}")
            if revision:
                raise UserError(f"{address} is a folder, and only the Hub has revisions: leave out --revision")
        else:
            self._hub = HfFileSystem(skip_instance_cache=True)  # what the Hub holds may change
            prefix = next(filter(address.startswith, _PREFIXES), "")
            root = f"datasets/{address.removeprefix(prefix).rstrip('/')}"
        self._folder = f"{root}/{task}"
        with explained(self.address):
            try:
                content = self._read(MANIFEST)
            except (FileNotFoundError, EntryNotFoundError):
                self._folder = root
                content = self._read(MANIFEST)
        try:
            self.manifest = Manifest.model_validate_json(content)
        except ValidationError:
            raise UserError(f"{MANIFEST} in {address} is damaged, or of another version of nnit") from None
        if self.manifest.task != task:
            raise UserError(f"{address} holds the zoo of {self.manifest.task}, not of {task}")

    def _read(self, name: str) -> bytes:
        """The content of one of the zoo's files."""
        path = f"{self._folder}/{name}"
        if self._hub is None:
            return Path(path).read_bytes()
        with self._hub.open(path, "rb", revision=self._revision, block_size=0) as file:  # 0: in one request
            return bytes(file.read())

    def read(self, name: str) -> bytes:
        """The content of one of the zoo's files; raises UserError if it cannot be read."""
        with explained(self.address):
            return self._read(name)

    @cached_property
    def index(self) -> bytes:
        """The content of index.parquet; raises UserError if it is not what the manifest promises."""
        content = self.read(INDEX)
        if Entry.of(content) != self.manifest.index:
            raise UserError(f"{INDEX} is not what the manifest promises: {self._advice}")
        return content

    def fetch(self, target: Path, progress: Progress | None = None, splits: Collection[str] = files.SPLITS) -> None:
        """Write the shards of these splits to `target`, as `files.fill` does; what is there already is kept."""
        files.fill(
            target, self.manifest, self.index, self._contents, splits=splits, progress=progress, advice=self._advice
        )

    def _contents(self, names: Collection[str]) -> Iterator[tuple[str, bytes]]:
        with ThreadPoolExecutor(_CONNECTIONS) as pool:
            try:
                yield from zip(names, pool.map(self.read, names), strict=True)
            finally:
                pool.shutdown(cancel_futures=True)

    @property
    def _advice(self) -> str:
        return f"{self.address} is damaged, or changed meanwhile; run the same command again, or choose a --revision"


def is_local(address: str) -> bool:
    """Whether an address names a folder, be it there or not, and not a data set of the Hub."""
    return Path(address).is_dir() or address.startswith(("/", ".", "~"))


class Target:
    """A data set of the Hub that zoos of these tasks can be pushed to; it is made, and public, if it is not there.

    Raises UserError if it holds other zoos, which the new README would not list, or if the Hub refuses.
    """

    def __init__(self, repository: str, tasks: Collection[str]) -> None:
        if repository.count("/") != 1:
            raise UserError(f"'{repository}' names no data set; write owner/name")
        self._repository = repository
        self._hub = HfApi()
        with explained(repository):
            self._hub.create_repo(repository, repo_type="dataset", exist_ok=True)
            info = self._hub.dataset_info(repository)
        self._earlier = info.sha
        self._there = {PurePosixPath(each.rfilename) for each in info.siblings or ()}
        held = {path.parent.name for path in self._there if path.match(f"*/{MANIFEST}")}
        if lost := sorted(held - set(tasks)):
            raise UserError(f"{repository} also holds {', '.join(lost)}: name all of its tasks with --task")

    def push(self, folder: Path) -> str:
        """Upload all of `folder` in one commit, which takes away what the tasks had else; returns its address."""
        paths = {PurePosixPath(path.relative_to(folder)): path for path in sorted(folder.rglob("*")) if path.is_file()}
        tasks = {path.parts[0] for path in paths if len(path.parts) > 1}
        gone = sorted(path for path in self._there - set(paths) if path.parts[0] in tasks)
        new = [CommitOperationAdd(str(name), path) for name, path in paths.items()]
        with explained(self._repository):
            commit = self._hub.create_commit(
                self._repository,
                [*new, *(CommitOperationDelete(str(name)) for name in gone)],
                commit_message="Upload with nnit-zoo push",
                repo_type="dataset",
                parent_commit=self._earlier,  # refused if somebody else has pushed meanwhile
            )
        return str(commit.commit_url)


@contextmanager
def explained(address: str) -> Iterator[None]:
    """What the Hub's client raises becomes a UserError that says what to do."""
    try:
        yield
    except OfflineModeIsEnabled:
        raise UserError(f"{address} cannot be reached, as HF_HUB_OFFLINE is set: unset it first") from None
    except LocalTokenNotFoundError:
        raise UserError("the Hub wants to know who you are; log in with: hf auth login") from None
    except (FileNotFoundError, EntryNotFoundError, NotImplementedError, ValueError) as error:
        raise UserError(f"nothing of that kind in {address}: {error}") from None
    except HfHubHTTPError as error:
        if error.response.status_code in (401, 403, 404):  # what is private seems not to be there
            raise UserError(f"the Hub refuses {address}: {error}; check the name, or hf auth login") from None
        again = "; run the same command again" if error.response.status_code in _PASSING else ""
        raise UserError(f"the Hub cannot serve {address}: {error}{again}") from None
    except (httpx2.HTTPError, ConnectionError, TimeoutError, RuntimeError) as error:  # the last three from Xet
        raise UserError(f"the connection to {address} failed ({error}); run the same command again") from None
