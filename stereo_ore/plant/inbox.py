"""The image files of a watched folder that are not handled yet, found in a time that hardly grows
with those that are.

A folder whose own time has not changed has got no new names, so it is not listed again; where the
operating system names what has changed, only that is looked at. A name that is used again (a
counter that was reset) shows in its file's time or size: files that are handled are looked at again
in turn, a few at a time.
"""

from __future__ import annotations

import os
import stat
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from stereo_ore.io.recordings.images import IMAGE_SUFFIXES
from stereo_ore.io.recordings.layouts import MOST_LEVELS, Listing
from stereo_ore.plant.changes import Changes
from stereo_ore.plant.clock import SYSTEM, Clock

Look = tuple[int, int]
"""Modification time [ns] and size [bytes] of a file."""

SURE_S, QUICK_S = 2.0, 0.005
"""A folder's time may be too coarse to tell the next change: it is listed once more after this
time, and until then again and again where that is quick."""
RELIST_S, RELIST_SHARE = 10.0, 0.01
"""It is listed anyway this often, for file systems that keep no such time, but never for more than
this share of the time."""
RECHECKS = 500
"""Handled files that are looked at again at each call."""


@dataclass
class _Folder:
    """One folder: what its time was when it was listed, whether the system said what has changed
    since, and its image files by name.
    """

    changed_ns: int = -1
    noticed_s: float = 0.0
    listed_s: float = float("-inf")
    took_s: float = 0.0
    said: bool = False
    folders: list[str] = field(default_factory=list)
    new: set[str] = field(default_factory=set)
    handled: dict[str, Look] = field(default_factory=dict)


class Inbox:
    """Files below `root`, in its subfolders too; hidden ones are none."""

    def __init__(self, root: Path, clock: Clock = SYSTEM) -> None:
        self.root = root
        self._clock = clock
        self._changes = Changes(root)
        self._folders: dict[str, _Folder] = {}
        self._rechecks: Iterator[tuple[str, str]] = iter(())

    def new_files(self) -> Listing:
        """Files that are not handled, as `layouts.list_files` gives them.

        Raises
        ------
        OSError
            When the folder can't be listed.
        """
        self._changes.gather()
        found: dict[str, _Folder] = {}
        self._visit("", found)
        for name in self._folders.keys() - found.keys():
            del self._folders[name]
        self._changes.keep(found)
        self._recheck()
        return {
            name: [self._path(name, file) for file in sorted(found[name].new)]
            for name in sorted(found)
        }

    def handle(self, file: Path, look: Look | None = None) -> None:
        """Take a file for handled as it looks now, or with `look`."""
        name, _, base = os.path.relpath(file, self.root).replace(os.sep, "/").rpartition("/")
        folder = self._folders.get(name)
        if folder is None:
            return
        folder.new.discard(base)
        seen = look or look_at(file)
        if seen is not None:
            folder.handled[base] = seen

    def handled(self) -> Iterator[tuple[str, Look]]:
        """Paths of the files that are handled, with their looks then."""
        for name, folder in self._folders.items():
            place = os.path.join(self.root, name, "")
            for base, look in folder.handled.items():
                yield place + base, look

    def _path(self, folder: str, base: str) -> Path:
        return self.root / folder / base if folder else self.root / base

    def _visit(self, name: str, found: dict[str, _Folder]) -> None:
        path = self.root / name if name else self.root
        folder = self._folders.setdefault(name, _Folder())
        try:
            self._update(name, folder, path)
        except OSError:
            if not name:
                raise
            return
        found[name] = folder
        if name.count("/") < MOST_LEVELS:
            for child in folder.folders:
                self._visit(f"{name}/{child}" if name else child, found)

    def _update(self, name: str, folder: _Folder, path: Path) -> None:
        """Note what is new in a folder where it may have changed; list it where nothing says what,
        and now and then all the same.
        """
        changed_ns, now = os.stat(path).st_mtime_ns, self._clock.monotonic()
        changed = changed_ns != folder.changed_ns
        if changed:
            folder.changed_ns, folder.noticed_s = changed_ns, now
        # What is said tells of files written anew as well, which leave their folder's time alone.
        said = self._changes.take(name)
        folder.said = bool(said) or (folder.said and not changed)
        if (changed and not said) or _is_due(folder, now):
            self._list(folder, path)
        self._note(folder, path, said)

    def _note(self, folder: _Folder, path: Path, names: set[str]) -> None:
        """Take over names in a folder that have come, changed or gone."""
        for name in names:
            look = None if name.startswith(".") else look_at(path / name)
            known = folder.handled.get(name)
            if look is None:
                folder.new.discard(name)
                folder.handled.pop(name, None)
            elif not name.lower().endswith(IMAGE_SUFFIXES):
                if (path / name).is_dir():
                    folder.folders = sorted({*folder.folders, name})
            elif known is None or _is_another(look, known):
                folder.handled.pop(name, None)
                folder.new.add(name)

    def _list(self, folder: _Folder, path: Path) -> None:
        began = time.perf_counter()
        names = set(os.listdir(path))
        visible = {name for name in names - folder.handled.keys() if not name.startswith(".")}
        folder.new = {name for name in visible if name.lower().endswith(IMAGE_SUFFIXES)}
        folder.folders = sorted(name for name in visible - folder.new if (path / name).is_dir())
        for gone in folder.handled.keys() - names:
            del folder.handled[gone]
        folder.listed_s = self._clock.monotonic()
        folder.took_s = time.perf_counter() - began

    def _recheck(self) -> None:
        """Find names among those handled that have got another file."""
        for _ in range(RECHECKS):
            place = next(self._rechecks, None)
            if place is None:
                names = [
                    (n, base) for n, folder in self._folders.items() for base in folder.handled
                ]
                self._rechecks = iter(names)
                return
            name, base = place
            folder = self._folders.get(name)
            if folder is None or base not in folder.handled:
                continue
            # A path object would cost more than the look.
            look = look_at(os.path.join(self.root, name, base))
            if look is not None and _is_another(look, folder.handled[base]):
                del folder.handled[base]
                folder.new.add(base)


def _is_due(folder: _Folder, now: float) -> bool:
    """Whether a folder is listed though its time is as it was, or what has changed is said."""
    if not folder.said and folder.listed_s < folder.noticed_s + SURE_S:
        return folder.took_s < QUICK_S or now >= folder.noticed_s + SURE_S
    return now - folder.listed_s >= max(RELIST_S, folder.took_s / RELIST_SHARE)


def _is_another(look: Look, before: Look) -> bool:
    """Whether a name has got another file; copying tools set an older time when they are done."""
    return look[0] > before[0] or look[1] != before[1]


def look_at(file: Path | str) -> Look | None:
    """What a file looks like; None for one that is gone. A link is what it points to."""
    try:
        seen = os.stat(file)
    except OSError:
        return None
    return (seen.st_mtime_ns, seen.st_size) if stat.S_ISREG(seen.st_mode) else (0, 0)
