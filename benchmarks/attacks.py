"""Attacks on what is on disk. Each is tried n times and says what became of each try.

What is allowed is ``same``, all is there and as it was, and ``refused``, with a sentence of ours;
for the log of writes, which is SQLite's own, also ``earlier``: what was there after an earlier
commit, and nothing else. All other outcomes say what went wrong. `tests/faults` tries a few of
each, and `python -m benchmarks.faults` many, and counts.
"""

from __future__ import annotations

import contextlib
import io
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import prbayes
from prbayes.cli import main
from prbayes.model.fingerprint import Identity
from prbayes.posterior.kernel import Checkpoint
from prbayes.response.store import Store, StoreError

Attack = Callable[[Path, np.random.Generator, int], Iterator[str]]

SAME, REFUSED, EARLIER = "same", "refused", "earlier"
ROWS, CHUNK = 300, 20
KEYS = np.random.default_rng(1).normal(size=(ROWS, 3))
VALUES = KEYS @ [1.0, 10.0, 100.0]
PACKAGE = str(Path(prbayes.__file__).parent)


# -- stores ----------------------------------------------------------------------------------------


def sound_store(folder: Path) -> Path:
    """Make a store of some responses of y and z, closed, and return its file."""
    store, other = Store(folder, "y", columns=3), Store(folder, "z", columns=1)
    for rows in np.array_split(np.arange(ROWS), ROWS // CHUNK):
        store.add(KEYS[rows], VALUES[rows])
    other.add(KEYS[:40, :1], VALUES[:40])
    store.close()
    other.close()
    return store.path


def found_in(store: Store) -> str:
    """Return whether all responses are there, or those of an earlier commit."""
    values, known = store.find(KEYS)
    if not np.array_equal(values[known], VALUES[known]):
        return "wrong numbers"
    if known.all():
        return SAME
    whole = np.flatnonzero(~known)[0] % CHUNK == 0
    return EARLIER if whole and not known[np.argmin(known) :].any() else "holes"


def outcome_of(read: Callable[[], str]) -> str:
    """Return what becomes of reading or writing a file."""
    try:
        return read()
    except StoreError as error:
        return sentence(str(error))
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def opened(folder: Path) -> str:
    """Return what becomes of a store that is opened."""

    def read() -> str:
        store = Store(folder, "y", columns=3)
        outcome = found_in(store)
        store.close()
        return outcome

    return outcome_of(read)


def sentence(text: str) -> str:
    """Return whether an error says what was got, what was expected, and what to do."""
    said = re.search(r"got .*expected .*; ", text, re.DOTALL)
    return REFUSED if said or "nothing was changed: " in text else f"poor words: {text}"


def damaged_files(
    folder: Path,
    sound: dict[str, bytes],
    damaged: Iterator[tuple[str, bytes]],
    read: Callable[[Path], str],
) -> Iterator[str]:
    """Try files with one of them damaged; what is refused has to be left as it is."""
    for name, content in damaged:
        for left in folder.iterdir():
            left.unlink()
        for other, whole in sound.items():
            (folder / other).write_bytes(whole)
        (folder / name).write_bytes(content)
        outcome = read(folder)
        if outcome == REFUSED and (folder / name).read_bytes() != content:
            outcome = "refused, and changed"
        yield outcome


def places(rng: np.random.Generator, size: int, n: int) -> Iterator[int]:
    """Return one place in each of n parts of so many bytes, so that no region is left out."""
    edges = np.linspace(0, size, n + 1).astype(int)
    for first, last in pairwise(edges):
        yield int(rng.integers(first, max(last, first + 1)))


def flips(rng: np.random.Generator, sound: dict[str, bytes], name: str, n: int) -> Any:
    """Yield a file with one bit flipped, in each of n parts of it."""
    for place in places(rng, len(sound[name]), n):
        damaged = bytearray(sound[name])
        damaged[place] ^= 1 << int(rng.integers(8))
        yield name, bytes(damaged)


def head_flips(rng: np.random.Generator, sound: dict[str, bytes], name: str, n: int) -> Any:
    """Yield a file with a bit flipped in the first bytes, which say what the file is."""
    for _, damaged in flips(rng, {name: sound[name][:200]}, name, n):
        yield name, damaged + sound[name][200:]


def cuts(rng: np.random.Generator, sound: dict[str, bytes], name: str, n: int) -> Any:
    """Yield a file that was cut, in each of n parts of it."""
    for place in places(rng, len(sound[name]), n):
        yield name, sound[name][:place]


def zeros(rng: np.random.Generator, sound: dict[str, bytes], name: str, n: int) -> Any:
    """Yield a file of which the end never reached the disk: zeros from a place in each part on."""
    whole = sound[name]
    for place in places(rng, len(whole), n):
        yield name, whole[:place] + bytes(len(whole) - place)


def more(rng: np.random.Generator, sound: dict[str, bytes], name: str, n: int) -> Any:
    """Yield a file with zeros behind its end."""
    for _ in range(n):
        yield name, sound[name] + bytes(int(rng.integers(1, 100_000)))


def store_attack(damage: Callable[..., Any]) -> Attack:
    """Return an attack on the file of a store that was closed."""

    def attack(folder: Path, rng: np.random.Generator, n: int) -> Iterator[str]:
        path = sound_store(folder)
        sound = {path.name: path.read_bytes()}
        yield from damaged_files(folder, sound, damage(rng, sound, path.name, n), opened)

    return attack


def log_attack(damage: Callable[..., Any]) -> Attack:
    """Return an attack on the log of writes that a killed process leaves beside the file."""

    def attack(folder: Path, rng: np.random.Generator, n: int) -> Iterator[str]:
        path = sound_store(folder / "open")
        store = Store(folder / "open", "y", columns=3)
        path.unlink()
        store = Store(folder / "open", "y", columns=3)
        for rows in np.array_split(np.arange(ROWS), ROWS // CHUNK):
            store.add(KEYS[rows], VALUES[rows])
        log = path.with_name(path.name + "-wal")
        # As they are while the process is at work; what is in memory goes with it.
        sound = {p.name: p.read_bytes() for p in (path, log)}
        store.close()
        shutil.rmtree(folder / "open")
        target = folder / "copy"
        target.mkdir()
        yield from damaged_files(target, sound, damage(rng, sound, log.name, n), opened)

    return attack


# -- processes that write --------------------------------------------------------------------------

WRITER = """
import sys, threading, types, numpy as np

# The package without PyMC, which takes seconds to import.
sys.modules["prbayes"] = types.ModuleType("prbayes")
sys.modules["prbayes"].__path__ = [sys.argv[4]]
from prbayes.response.store import Store

folder, number, chunks = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
store = Store(folder, "y", columns=2)
print("ready", flush=True)
sys.stdin.readline()

def write(first):
    for i in range(first, chunks, 2):
        keys = np.column_stack([np.full(5, float(number)), 5.0 * i + np.arange(5)])
        store.add(keys, keys @ [1e6, 1.0])
        sys.stdout.write(f"{i}\\n")
        sys.stdout.flush()

threads = [threading.Thread(target=write, args=(first,)) for first in range(2)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print("done", flush=True)
sys.stdin.readline()
print(len(store), flush=True)
"""


def writer(folder: Path, number: int, chunks: int) -> subprocess.Popen[str]:
    """Return a process that writes chunks of five responses in two threads, and says so."""
    return subprocess.Popen(
        [sys.executable, "-c", WRITER, str(folder), str(number), str(chunks), PACKAGE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def told(process: subprocess.Popen[str], word: str) -> None:
    """Wait until a process says a word."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == word:
            return
    raise AssertionError("the process ended")


def go_on(process: subprocess.Popen[str]) -> None:
    """Let a process go on that waits."""
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def killed_writers(folder: Path, rng: np.random.Generator, n: int) -> Iterator[str]:
    """Kill two processes of two threads each, that write at once, at some moment; n times."""
    for attempt in range(n):
        own = folder / str(attempt)
        processes = [writer(own, number, 100_000) for number in range(2)]
        for process in processes:
            told(process, "ready")
        for process in processes:
            go_on(process)
        said = []
        for process in processes:
            time.sleep(float(rng.uniform(0, 0.15)))
            process.send_signal(signal.SIGKILL)
            words = process.communicate()[0].split("\n")
            said.append([int(word) for word in words[:-1] if word])  # the last may be cut
        yield committed(own, said)


def committed(folder: Path, said: list[list[int]]) -> str:
    """Return whether all is there that processes said they had written, and nothing else."""

    def read() -> str:
        store = Store(folder, "y", columns=2)
        for number, chunks in enumerate(said):
            points = 5.0 * np.array(chunks)[:, None] + np.arange(5) if chunks else np.empty((0, 5))
            keys = np.column_stack([np.full(points.size, float(number)), points.ravel()])
            values, known = store.find(keys)
            if not known.all():
                return "lost"
        keys, values = store.known()
        if not np.array_equal(values, keys @ [1e6, 1.0]):
            return "wrong numbers"
        # A kill may fall between a commit and the word of it, in each of the threads.
        unsaid = len(store) - 5 * sum(map(len, said))
        if unsaid not in range(0, 5 * 2 * len(said) + 1, 5):
            return f"{unsaid} responses that nobody wrote"
        store.add(np.array([[7.0, 7.0]]), np.array([7_000_007.0]))
        store.close()
        return SAME

    return outcome_of(read)


def threads_that_write(folder: Path, rng: np.random.Generator, n: int) -> Iterator[str]:
    """Write with four threads on two stores of one folder at once, each of them n / 4 chunks."""
    stores = [Store(folder, "y", columns=2) for _ in range(2)]
    said: list[list[int]] = [[], [], [], []]

    def write(number: int) -> None:
        for i in range(-(-n // 4)):
            keys = np.column_stack([np.full(5, float(number)), 5.0 * i + np.arange(5)])
            stores[number % 2].add(keys, keys @ [1e6, 1.0])
            said[number].append(i)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    outcome = committed(folder, said)
    for chunks in said:
        yield from [outcome] * len(chunks)


# -- full disks ------------------------------------------------------------------------------------


@contextlib.contextmanager
def room_for(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond a size, as on a disk that is full then."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def full_disk(folder: Path, rng: np.random.Generator, n: int) -> Iterator[str]:
    """Fill the disk while a store is written; then free it, and write the rest."""
    for attempt, size in enumerate(places(rng, 250_000, n)):
        yield _filled(folder / str(attempt), size)


def _filled(folder: Path, size: int) -> str:
    chunks = np.array_split(np.arange(ROWS), ROWS // CHUNK)
    written = 0
    try:
        with room_for(size):
            store = Store(folder, "y", columns=3)
            for rows in chunks:
                store.add(KEYS[rows], VALUES[rows])
                written += 1
    except StoreError as error:
        if sentence(str(error)) != REFUSED or "free some space" not in str(error):
            return f"poor words: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    try:
        store = Store(folder, "y", columns=3)
        if len(store) != written * CHUNK:
            return f"{len(store)} of {written * CHUNK} responses"
        for rows in chunks[written:]:
            store.add(KEYS[rows], VALUES[rows])
        outcome = found_in(store)
        store.close()
    except Exception as error:
        return f"afterwards {type(error).__name__}: {error}"
    return outcome


# -- checkpoints -----------------------------------------------------------------------------------

STATE = {"thetas": np.random.default_rng(2).normal(size=(40, 3)), "one": np.array(np.nan)}
SETTINGS = {"draws": 10, "entropy": "7"}
PROBLEM = Identity({"mu": ()}, {"mu": "Normal(0, 1)"}, (), ())


def sound_checkpoint(path: Path) -> None:
    """Write a checkpoint."""
    Checkpoint(path, PROBLEM, SETTINGS).save(STATE, {"stage": 1})


def read_checkpoint(folder: Path) -> str:
    """Return what becomes of a checkpoint that is gone on with."""

    def read() -> str:
        found = Checkpoint(folder / "run.nc", PROBLEM, SETTINGS)
        same = found.note == {"stage": 1} and set(found.arrays) == set(STATE)
        same = same and all(np.array_equal(found.arrays[k], STATE[k], True) for k in STATE)
        return SAME if same else "wrong numbers"

    return outcome_of(read)


def checkpoint_attack(damage: Callable[..., Any]) -> Attack:
    """Return an attack on the file of a checkpoint."""

    def attack(folder: Path, rng: np.random.Generator, n: int) -> Iterator[str]:
        path = folder / "run.nc"
        sound_checkpoint(path)
        sound = {path.name: path.read_bytes()}
        damaged = damage(rng, sound, path.name, n)
        yield from damaged_files(folder, sound, damaged, read_checkpoint)

    return attack


def checkpoint_on_a_full_disk(folder: Path, rng: np.random.Generator, n: int) -> Iterator[str]:
    """Fill the disk while the next state is written: that of before is kept."""
    path = folder / "run.nc"
    for size in places(rng, 40_000, n):
        sound_checkpoint(path)

        def write(size: int = size) -> str:
            with room_for(size):
                Checkpoint(path, PROBLEM, SETTINGS).save({"t": np.arange(5_000.0)}, {"stage": 2})
            return "not refused"

        outcome = outcome_of(write)
        kept = read_checkpoint(folder)
        alone = [p.name for p in folder.iterdir()] == [path.name]
        yield outcome if kept == SAME and alone else f"{outcome}, and then {kept}"
        path.unlink()


# -- files that are given to the command line --------------------------------------------------------


def sound_results(path: Path) -> None:
    """Write a posterior as users save it."""
    draws = np.random.default_rng(1).normal(size=(2, 50))
    tree = {"posterior": xr.Dataset({"mu": (("chain", "draw"), draws)}, attrs={"model": "a\nb"})}
    xr.DataTree.from_dict(tree).to_netcdf(path, engine="h5netcdf")


def reported(folder: Path) -> str:
    """Return what the command line says to a file: a report, or one line."""
    out, err = io.StringIO(), io.StringIO()
    given = ["report", str(folder / "p.nc"), "--no-pictures", "--out", str(folder / "r.html")]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(given)
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    said = err.getvalue()
    if code == 0:
        return "reported"
    one_line = said.startswith("prbayes: ") and said.count("\n") == 1
    return REFUSED if code == 2 and one_line and len(said) < 2_000 else f"poor words: {said!r:.300}"


def crafted(damage: Callable[..., Any]) -> Attack:
    """Return an attack on a file of results that is to be reported."""

    def attack(folder: Path, rng: np.random.Generator, n: int) -> Iterator[str]:
        path = folder / "p.nc"
        sound_results(path)
        sound = {path.name: path.read_bytes()}
        yield from damaged_files(folder, sound, damage(rng, sound, path.name, n), reported)

    return attack


# By what is attacked and how: the attack, and how often it is tried in the default run.
ATTACKS: dict[str, tuple[Attack, int]] = {
    "store, flipped bits": (store_attack(flips), 40),
    "store, flipped bits of its head": (store_attack(head_flips), 20),
    "store, cut": (store_attack(cuts), 10),
    "store, an end of zeros": (store_attack(zeros), 10),
    "store, zeros behind its end": (store_attack(more), 3),
    "log of writes, flipped bits": (log_attack(flips), 10),
    "log of writes, cut": (log_attack(cuts), 10),
    "log of writes, zeros behind its end": (log_attack(more), 2),
    "two processes that write and are killed": (killed_writers, 1),
    "threads that write": (threads_that_write, 40),
    "store on a full disk": (full_disk, 12),
    "checkpoint, flipped bits": (checkpoint_attack(flips), 12),
    "checkpoint, cut": (checkpoint_attack(cuts), 8),
    "checkpoint, an end of zeros": (checkpoint_attack(zeros), 4),
    "checkpoint on a full disk": (checkpoint_on_a_full_disk, 3),
    "results for the report, cut": (crafted(cuts), 4),
}
ALLOWED: dict[str, set[str]] = {
    "log of writes": {SAME, EARLIER},
    "results for the report": {REFUSED, "reported"},
}


def allowed(name: str) -> set[str]:
    """Return the outcomes that are promised."""
    return ALLOWED.get(name.split(",")[0], {SAME, REFUSED})
