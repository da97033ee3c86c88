"""The model card of a checkpoint: what it generates, how to use it, how it was trained."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

CARD = """---
{licence}library_name: nnit
tags:
- weight-generation
- {task}
---
# {name} for {task}

{description}

Generates the weights of small {task} policies, of a requested architecture. Trained on the policies of seen
architectures and training seeds of the `nnit` zoo.

```python
from nnit_baselines import SampleRequest, get
from nnit_zoo import tasks
from nnit_zoo.architecture import Architecture

task = tasks.get("{task}")
generator = get("{method}").from_pretrained("FOLDER_OR_HUB_ID")
architecture = Architecture.parse("16-64-64-32", task.inputs, task.outputs)
policies = generator.sample(SampleRequest(architecture, policies=10, seed=0))
```

To score it: `nnit-bench run --method {method} --task {task} --checkpoint FOLDER_OR_HUB_ID`.

| Training | |
|---|---|
{facts}
"""


def card(
    name: str, method: str, task: str, *, description: str, training: Mapping[str, Any], licence: str | None
) -> str:
    """The card of a checkpoint of the class `name`, which is found as `method`, for `task`."""
    facts = "\n".join(f"| {key.replace('_', ' ')} | {value} |" for key, value in training.items())
    line = f"license: {licence}\n" if licence else ""
    return CARD.format(name=name, method=method, task=task, description=description, facts=facts, licence=line)
