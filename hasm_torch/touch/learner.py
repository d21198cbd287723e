"""Learning beside the control loop: a thread with a model of its own, which hands out copies.

    job (keep, forget, save, load) ──queue──► Learner ──copy of the model, what to say──► Session

The control loop never waits: it goes on with the model that it has until it is handed another.
"""

import copy
import queue
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from hasm_torch.config import HASMConfig
from hasm_torch.data.episodes import load_episodes
from hasm_torch.data.training import train
from hasm_torch.episode import Episode
from hasm_torch.model.hasm import HASM
from hasm_torch.touch.ghosts import ways
from hasm_torch.touch.shelf import Shelf
from hasm_torch.touch.simulated import BUNDLED, check_body, write_dataset


@dataclass(frozen=True)
class Outcome:
    """What a job came to.

    Attributes:
        said: What to tell the person.
        failed: Whether it came to nothing.
        model: A copy of what is known now, or None where that is as it was.
        ways: The same in each of `ghosts.WAYS`.
        shown: Demonstrations that can be played, by their numbers.
    """

    said: str
    failed: bool = False
    model: HASM | None = None
    ways: Sequence[HASM] = ()
    shown: dict[int, Episode] | None = None


class Learner:
    """Learns, forgets, saves and loads, one job after the other.

    Attributes:
        busy: What it does at the moment, and since when, s of `time.monotonic`; None when idle.

    Args:
        scene: Where the robot is taught.
        model: What it knows at the start; it may be empty.
        shelf: Where things are saved.
        deliver: Is handed the outcome of every job, in the learner's thread.
    """

    def __init__(
        self, scene: str, model: HASM, shelf: Shelf, deliver: Callable[[Outcome], None]
    ) -> None:
        self.scene, self.shelf = scene, shelf
        self.busy: tuple[str, float] | None = None
        self._model, self._deliver = model, deliver
        self._shown: dict[int, Episode] = {}
        self._jobs: queue.Queue[tuple[str, Callable[[], Outcome]] | None] = queue.Queue()
        self._processes: ProcessPoolExecutor | None = None
        self._thread = threading.Thread(target=self._work, name="learner", daemon=True)
        self._thread.start()

    def keep(self, episode: Episode, name: str) -> None:
        """Learn a demonstration."""
        self._jobs.put(("Learning what you showed", lambda: self._keep(episode, name)))

    def forget(self) -> None:
        """Forget the demonstration that was learned last."""
        self._jobs.put(("Forgetting", self._forget))

    def save(self, kind: str, name: str) -> None:
        """Save what was shown as a dataset, or what is known as a checkpoint.

        Raises:
            ValueError: It cannot be called so.
        """
        place = self.shelf.place(kind, name)
        self._jobs.put((f"Saving the {kind} {name}", lambda: self._save(kind, place)))

    def load(self, kind: str, name: str) -> None:
        """Know what a checkpoint knows, or learn a dataset, in place of what is known.

        Raises:
            ValueError: It cannot be called so.
        """
        place = self.shelf.place(kind, name)
        self._jobs.put((f"Loading the {kind} {name}", lambda: self._load(kind, place)))

    def load_bundled(self, datasets: Path) -> None:
        """Learn the bundled teaching of the scene, from the folder of the bundled datasets."""
        place = datasets / BUNDLED[self.scene]
        self._jobs.put((f"Learning the bundled teaching {place.name}", lambda: self._bundle(place)))

    def close(self) -> None:
        """End after the job at hand."""
        self._jobs.put(None)
        self._thread.join()
        if self._processes is not None:
            self._processes.shutdown(cancel_futures=True)

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            text, work = job
            self.busy = text, time.monotonic()
            try:
                outcome = work()
            # A damaged file fails in many ways; whatever it was, the next job is done.
            except Exception as error:
                outcome = Outcome(f"{text} did not work: {error}", failed=True)
            self.busy = None
            self._deliver(outcome)

    def _keep(self, episode: Episode, name: str) -> Outcome:
        begun = time.perf_counter()
        known = self._model.learn(episode, name)
        took = 1e3 * (time.perf_counter() - begun)
        self._shown[known.number] = episode
        touched = ", ".join(known.patches) or "no patch"
        return self._known(
            f"Learned demonstration {known.number} ({known.seconds:.1f} s, {touched}) "
            f"in {took:.0f} ms."
        )

    def _forget(self) -> Outcome:
        known = self._model.episodes
        if not known:
            raise ValueError("it knows nothing that could be forgotten")
        number = known[-1].number
        begun = time.perf_counter()
        self._model.forget(number)
        took = 1e3 * (time.perf_counter() - begun)
        self._shown.pop(number, None)
        return self._known(f"Forgot demonstration {number} in {took:.0f} ms.")

    def _save(self, kind: str, place: Path) -> Outcome:
        if kind == "checkpoint":
            self._model.save_pretrained(place)
            return Outcome(f"Saved what it knows: {place}")
        if not self._shown:
            raise ValueError("nothing was shown yet: record and keep a demonstration first")
        self._elsewhere(write_dataset, place, list(self._shown.values()), self.scene)
        return Outcome(f"Saved {len(self._shown)} demonstrations as a LeRobot dataset: {place}")

    def _load(self, kind: str, place: Path) -> Outcome:
        if kind == "checkpoint":
            return self._take(HASM.from_pretrained(place), {}, f"Loaded {place}.")
        episodes = list(load_episodes(place))
        model = HASM(self._model.config, self._model.body)
        model.fit(episodes)
        return self._take(model, dict(enumerate(episodes)), f"Learned {place}.")

    def _bundle(self, place: Path) -> Outcome:
        with tempfile.TemporaryDirectory() as folder:
            self._elsewhere(_train, place, Path(folder))
            model = HASM.from_pretrained(folder)
        return self._take(model, {}, f"It knows the bundled teaching: {place.name}.")

    def _take(self, model: HASM, shown: dict[int, Episode], said: str) -> Outcome:
        check_body(model.body, self.scene)
        self._model, self._shown = model, shown
        return self._known(said)

    def _known(self, said: str) -> Outcome:
        model = copy.deepcopy(self._model)
        return Outcome(said, model=model, ways=ways(model), shown=dict(self._shown))

    def _elsewhere(self, work: Callable[..., Any], *args: Any) -> None:
        """Do long work in a process of its own: the control loop keeps the time."""
        if self._processes is None:
            spawn = get_context("spawn")
            self._processes = ProcessPoolExecutor(1, spawn, torch.set_num_threads, (1,))
        self._processes.submit(work, *args).result()


def _train(root: Path, folder: Path) -> None:
    train(root, HASMConfig()).model.save_pretrained(folder)
