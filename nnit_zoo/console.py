"""What the command lines share: kinds of options, and tables and JSON on stdout; rich is imported when needed."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from cyclopts import Parameter, Token, convert

from nnit_zoo.errors import UserError


def split_at_commas(kind: Any, tokens: Sequence[Token]) -> Any:
    """The value of an option that may be repeated and may hold commas, as a converter of cyclopts."""
    names = [token.evolve(value=name) for token in tokens for name in token.value.split(",") if name]
    if not names:
        raise UserError(f"{tokens[0].keyword} needs a name")
    return convert(kind, names)


Json = Annotated[bool, Parameter(name="--json")]
SEVERAL = Parameter(converter=split_at_commas, show_default=lambda names: ", ".join(names) or "all")
Names = Annotated[tuple[str, ...], SEVERAL]


def print_json(content: Any) -> None:
    """Print indented JSON."""
    sys.stdout.write(json.dumps(content, indent=2) + "\n")


def print_rows(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> None:
    """Print these columns as a table, without those that no row has a value for."""
    filled = [column for column in columns if any(row[column] is not None for row in rows)]
    print_table(
        [column.replace("_", " ") for column in filled],
        [[_text(row[column]) for column in filled] for row in rows],
    )


def _text(value: Any) -> str:
    return "-" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table."""
    from rich.box import SIMPLE_HEAD  # noqa: PLC0415
    from rich.console import Console  # noqa: PLC0415
    from rich.table import Table  # noqa: PLC0415

    console, table = Console(), Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    texts = [[column, *(row[number] for row in rows)] for number, column in enumerate(columns)]
    whole = [max(map(len, each)) for each in texts if not any(" " in text for text in each)]
    roomy = sum(whole) + 8 * (len(columns) - len(whole)) + 2 * len(columns) <= console.width
    for each in texts:  # on a narrow screen, columns of several words break first
        table.add_column(each[0], overflow="fold", no_wrap=roomy and not any(" " in text for text in each))
    for row in rows:
        table.add_row(*row)
    console.print(table)
