"""Items that are made, kept in the folder of their pictures so that a stopped run goes on."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fits.commands.page import Table
from fits.paper.item import Item, Number
from fits.record import write_json
from jaxsky.settings import Experiment

FILE = "items.json"


def _item(values: dict[str, Any]) -> Item:
    table = values.pop("table")
    numbers = tuple(Number(**number) for number in values.pop("numbers"))
    if table is not None:
        table = Table(tuple(table["header"]), tuple(tuple(row) for row in table["rows"]))
    return Item(**values, table=table, numbers=numbers)


def _values(item: Item) -> dict[str, Any]:
    return item._asdict() | {
        "table": item.table and item.table._asdict(),
        "numbers": [number._asdict() for number in item.numbers],
    }


class Store:
    """The items in a folder, of one set of settings.

    Parameters
    ----------
    out : the folder, made if it is not there
    settings : of the items
    resume : go on with those that are there
    overwrite : those that are there may be replaced; of other settings, they are discarded when
        the first new one is there
    """

    def __init__(
        self, out: Path, settings: Experiment, resume: bool = False, overwrite: bool = False
    ) -> None:
        self.out, self.items = out, dict[str, Item]()
        self._stale = False
        self._settings = settings.model_dump(mode="json", exclude_none=True)
        path = out / FILE
        if path.exists() and not (resume or overwrite):
            raise ValueError(
                f"{out}: holds figures already; go on with --resume, replace them with "
                "--overwrite, or choose another --out."
            )
        if path.exists():
            self._load(path, overwrite)
        out.mkdir(parents=True, exist_ok=True)

    def _load(self, path: Path, overwrite: bool) -> None:
        try:
            held = json.loads(path.read_text())
            items = {values["label"]: _item(values) for values in held["items"]}
            settings = held["settings"]
        except (ValueError, KeyError, TypeError):
            if overwrite:
                return
            raise ValueError(f"{path}: is damaged; start again with --overwrite.") from None
        self.items = items
        if settings == self._settings:
            return
        if not overwrite:
            raise ValueError(
                f"{self.out}: holds figures of other settings; choose another --out, or start "
                "again with --overwrite."
            )
        self._stale = True

    def has(self, label: str) -> bool:
        """True if an item could be made, and its picture is there."""
        item = None if self._stale else self.items.get(label)
        if item is None or (item.picture is None and item.table is None):
            return False
        return item.picture is None or (self.out / item.picture).is_file()

    def add(self, item: Item) -> None:
        """Keep an item, whose picture is written already; those of other settings go."""
        if self._stale:
            old = {i.picture for i in self.items.values()} - {None, item.picture}
            for picture in old:
                (self.out / str(picture)).unlink(missing_ok=True)
            self.items, self._stale = {}, False
        self.items[item.label] = item
        self._write()

    def ordered(self, labels: Iterable[str]) -> list[Item]:
        """The items that are there, in an order."""
        return [self.items[label] for label in labels if label in self.items]

    def _write(self) -> None:
        items = [_values(item) for item in self.items.values()]
        write_json(self.out / FILE, {"settings": self._settings, "items": items})
