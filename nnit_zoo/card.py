"""A zoo as a data set for everybody: Parquet with weights, a README card and a Croissant description.

`datasets.load_dataset(folder, task)` reads it without this package, and `nnit-zoo download --source folder` with it.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from huggingface_hub import DatasetCardData

from nnit_zoo import files, tasks
from nnit_zoo.atomic import write_atomically, write_bytes, write_json
from nnit_zoo.errors import UserError
from nnit_zoo.places import data_folder
from nnit_zoo.summary import by_split
from nnit_zoo.tasks.mnist import FEATURES
from nnit_zoo.zoo import Zoo

DESCRIPTION = (
    "Small Tanh networks that solve a task each, made by hypernetworks, to train and compare generators of weights on."
)
PAPER = "https://arxiv.org/abs/2603.00180"
HERE = "path/to/this/folder"
_SCHEMA = pa.schema(
    [
        *(field for field in files.INDEX_SCHEMA if field.name not in ("shard", "row")),
        pa.field("parameters", pa.list_(pa.float16()), nullable=False),
    ]
)
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "recordSet": "cr:recordSet",
    "repeated": "cr:repeated",
    "source": "cr:source",
}

README = """# {title}

{description}

{table}

*Seen* policies, of training seeds, are the corpus. *Unseen* and *excluded* architectures and the policies of *held-out
seeds* are yardsticks: no generator should learn from them. Splits that played different numbers of episodes did not
meet the same starts, so small differences of their scores mean nothing.

## Use it

```python
import torch
from datasets import load_dataset

policy = load_dataset("{repository}", "{task}", split="seen")[0]
widths = [{inputs}, *map(int, policy["architecture"].split("-")), {outputs}]
rest, modules = torch.tensor(policy["parameters"]), []
for into, out in zip(widths, widths[1:]):
    block, rest = rest[: out * (into + 1)].view(out, into + 1), rest[out * (into + 1) :]
    linear = torch.nn.Linear(into, out)
    linear.load_state_dict({{"weight": block[:, :-1], "bias": block[:, -1]}})
    modules += [linear, torch.nn.Tanh()]
network = torch.nn.Sequential(*modules[:-1])
```

`parameters` are float16: layer by layer, row by row, a row per output neuron with its bias at the end. A network takes
standardised observations, `(observation - mean) / std` with `observation_mean` and `observation_std` of `task.json`.
An observation of MNIST-PCA32 is a digit's `(pixels / 255 - mean) @ components.T`; `MNIST-PCA32/features.safetensors`
has this basis, and all digits' observations and labels.

With the `nnit` package: `nnit-zoo download --task {task} --source {repository}`, then `nnit_zoo.load("{task}")`.

## Columns

| Column | |
|---|---|
| `id` | task / hidden widths / seed of the hypernetwork |
| `architecture` | hidden widths |
| `ghn_seed` | seed of the hypernetwork that made the policy; those from 128 on are held out |
| `success_once`, `success_at_end`, `return` | means over `episodes`; MNIST-PCA32 has its accuracy in `return` |
| `sha256` | of the parameters as stored |
| `n_params` | number of weights and biases |
| `weight_norm` | L2 norm of all parameters |
| `parameters` | weights and biases |

`<task>/*.safetensors` hold the same weights stacked per architecture, and `index.parquet` says where each policy is.
`<task>/build/`, where a task has it, holds the hypernetworks, the expert, and the scores of all candidates.

## Licence

CC BY 4.0; MNIST-PCA32's features CC BY-SA 3.0, as MNIST itself. The method is of NNiT
([arXiv 2603.00180](https://arxiv.org/abs/2603.00180)); these networks were built anew.
"""


def readme(indexes: Sequence[tuple[files.Manifest, pa.Table]], repository: str = HERE) -> str:
    """The README card of a data set with these zoos, the first of which is its default configuration."""
    configs: list[dict[str, Any]] = [
        {
            "config_name": manifest.task,
            "data_files": [{"split": split, "path": _path(manifest.task, split)} for split in by_split(index)],
        }
        for manifest, index in indexes
    ]
    configs[0]["default"] = True
    header = DatasetCardData(
        license="cc-by-4.0", pretty_name="NNiT policy zoo", tags=["model-zoo", "weight-generation"], configs=configs
    )
    names = ("Task", "Split", "Architectures", "Policies", "Episodes of each", "Success at end", "Return")
    lines = ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
    for manifest, index in indexes:
        for split, row in by_split(index).items():
            success = "" if row["success_at_end"] is None else f"{row['success_at_end']:.1%}"
            counts = f"{row['architectures']} | {row['policies']:,} | {row['episodes']}"
            numbers = f"{counts} | {success} | {row['return']:.3g}"
            lines.append(f"| {manifest.task} | {split} | {numbers} |")
    first = indexes[0][0]
    text = README.format(
        title="Policies for generators of neural-network weights",
        description=DESCRIPTION,
        table="\n".join(lines),
        repository=repository,
        task=first.task,
        inputs=first.inputs,
        outputs=first.outputs,
    )
    return f"---\n{header.to_yaml()}\n---\n{text}"


def write_dataset(folder: Path, zoos: Sequence[Zoo], repository: str = HERE) -> None:
    """Write the zoos to `folder` as a data set: per task its files, task.json and policies/<split>.parquet.

    The zoo that ships also gets what it was made from, and all candidates' scores, in build/, and in task.json how.
    Raises UserError if a zoo lacks a shard, or if `folder` holds another one, which its README would not list.
    """
    there = {path.parent.name for path in folder.glob(f"*/{files.MANIFEST}")}
    if lost := sorted(there - {zoo.task for zoo in zoos}):
        raise UserError(f"{folder} holds the data set of {', '.join(lost)}; choose another folder")
    for zoo in zoos:
        place = folder / zoo.task
        zoo.check_whole()
        for name in (*zoo.manifest.files, files.MANIFEST):
            write_atomically(place / name, partial(shutil.copyfile, zoo.folder / name))
        record, data = tasks.get(zoo.task).record, data_folder(zoo.task)
        ships = (data / files.MANIFEST).is_file() and files.Manifest.read(data) == zoo.manifest
        write_json(place / "task.json", {name: value for name, value in record.items() if name != "build" or ships})
        if (data / FEATURES).is_file():  # what MNIST-PCA32's policies see of a digit
            write_atomically(place / FEATURES, partial(shutil.copyfile, data / FEATURES))
        if ships:
            for name in (files.EXPERT, files.GHNS, files.SELECTION, files.CANDIDATE_EPISODES):
                if (data / name).is_file():  # MNIST-PCA32 has no expert
                    write_atomically(place / "build" / name, partial(shutil.copyfile, data / name))
        else:
            shutil.rmtree(place / "build", ignore_errors=True)  # of a zoo that was exported there before
        for split in by_split(zoo.index):
            write_atomically(folder / _path(zoo.task, split), partial(_write_policies, zoo, split))
    indexes = [(zoo.manifest, zoo.index) for zoo in zoos]
    write_bytes(folder / "README.md", readme(indexes, repository).encode())
    write_json(folder / "croissant.json", croissant(folder, zoos))


def _path(task: str, split: str) -> str:
    return f"{task}/policies/{split}.parquet"


def _write_policies(zoo: Zoo, split: str, path: Path) -> None:
    """Write the rows of a split with their parameters, a row group per architecture."""
    with pq.ParquetWriter(path, _SCHEMA, compression="zstd", use_dictionary=False) as writer:
        for architecture in zoo.architectures(split):
            chosen = (pc.field("architecture") == str(architecture)) & (pc.field("split") == split)
            rows = zoo.filter(chosen).index.drop_columns(["shard", "row"])
            flat = zoo.batch(architecture, split).flat().numpy()
            ends = np.arange(len(flat) + 1, dtype=np.int32) * flat.shape[1]
            parameters = pa.ListArray.from_arrays(ends, pa.array(flat.ravel()))
            writer.write_table(rows.append_column(_SCHEMA.field("parameters"), parameters))


def croissant(folder: Path, zoos: Sequence[Zoo]) -> dict[str, Any]:
    """The Croissant 1.0 description of the data set in `folder`: a record set per task and split."""
    parts = [(zoo.task, split) for zoo in zoos for split in by_split(zoo.index)]
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": "nnit-zoo",
        "description": DESCRIPTION,
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "license": "https://creativecommons.org/licenses/by/4.0/",
        "url": PAPER,
        "citeAs": PAPER,
        "version": version("nnit"),
        "distribution": [
            {
                "@type": "cr:FileObject",
                "@id": _path(task, split),
                "name": f"{task}-{split}",
                "contentUrl": _path(task, split),
                "encodingFormat": "application/x-parquet",
                "sha256": files.sha256_of(folder / _path(task, split)),
            }
            for task, split in parts
        ],
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": f"{task}/{split}",
                "name": f"{task}-{split}",
                "field": list(_fields(task, split)),
            }
            for task, split in parts
        ],
    }


def _fields(task: str, split: str) -> Iterator[dict[str, Any]]:
    for column in _SCHEMA:
        kind = column.type.value_type if pa.types.is_list(column.type) else column.type
        name = "sc:Text" if pa.types.is_string(kind) else "sc:Integer" if pa.types.is_integer(kind) else "sc:Float"
        yield {
            "@type": "cr:Field",
            "@id": f"{task}/{split}/{column.name}",
            "name": column.name,
            "dataType": name,
            "source": {"fileObject": {"@id": _path(task, split)}, "extract": {"column": column.name}},
        } | ({"repeated": True} if pa.types.is_list(column.type) else {})
