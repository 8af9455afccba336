"""Several processes on one precomputation, on one machine or on many.

Batches of vertices need nothing of each other: batch k is computed by process k mod N and kept in
the folder that all share, where after every round all read those of the others. Each then chooses
the triangles to split by itself; digests of what was chosen are compared.

Processes find each other, wait for each other and notice deaths through the coordination service
of `jax.distributed`, which process 0 runs. Nothing else goes that way: every process computes with
devices of its own, by the same programs as a process that is alone.
"""

import hashlib
import logging
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np

from diffopt.errors import InputError

#: Exit code of a process that ends because another one did.
DESERTED = 75
#: Seconds in which what another process has written must be seen.
PATIENCE = 60.0
_PREFIX = "diffopt"
# Longer than any round: that a process is dead is noticed by its heartbeats.
_FOREVER_MS = 30 * 24 * 3600 * 1000
_WATCH_S = 2.0

#: What is not lost, and how to go on.
KEPT = "finished batches are kept, and the same command goes on from them"

Result = TypeVar("Result")


class DesertedError(InputError):
    """Another process of the run has ended."""


class Company:
    """The processes of one run, as one of them sees them; made by `joined`.

    Attributes
    ----------
    index, count
        Number of this process, and how many there are.
    leaving
        Called before the process ends because another one did: gives back locks.
    """

    def __init__(self, index: int, count: int, client: Any, watched: bool) -> None:
        self.index, self.count, self._client = index, count, client
        self.leaving: list[Callable[[], None]] = []
        self._ended = False
        self.tell(f"host/{index}", socket.gethostname())
        self._watching = threading.Thread(target=self._watch, daemon=True)
        if watched and count > 1:
            self._watching.start()

    def tell(self, name: str, text: str) -> None:
        """Say something that all can hear; once for each name."""
        self._client.key_value_set(f"{_PREFIX}/{name}", text)

    def hear(self, name: str) -> str:
        """What was told under a name; waits for it."""
        return _waiting(
            lambda: self._client.blocking_key_value_get(f"{_PREFIX}/{name}", _FOREVER_MS)
        )

    def together(self, step: str) -> None:
        """Wait until all processes have come to a step; each is passed once."""
        _waiting(lambda: self._client.wait_at_barrier(f"{_PREFIX}/{step}", _FOREVER_MS))

    def agreed(self, step: str, *found: Any) -> None:
        """Compare what was found with process 0, by digest.

        Raises
        ------
        InputError
            If it is something else here.
        """
        digest = hashlib.sha256()
        for one in found:
            values = np.ascontiguousarray(one)
            digest.update(f"{values.dtype} {values.shape}".encode())
            digest.update(values.tobytes())
        if self.index == 0:
            self.tell(f"found/{step}", digest.hexdigest())
        elif self.hear(f"found/{step}") != digest.hexdigest():
            raise InputError(
                f"{self.name(self.index)} found something else than process 0: {step}; all must "
                "have the same scene and the same versions, on processors of one kind"
            )

    def alike(self, look: Callable[[], Result]) -> Result:
        """Something that every process does before the work, or none.

        Raises
        ------
        InputError
            That of the first process that fails, in process 0.
        SystemExit
            In the others.
        """
        found: list[Result] = []
        fault: InputError | None = None
        try:
            found.append(look())
        except InputError as error:
            fault = error
        self.tell(f"fault/{self.index}", "" if fault is None else str(fault))
        self.together("looked")
        if self.index:
            if fault is None and self.hear("verdict") == "fine":
                return found[0]
            raise SystemExit(DESERTED)
        pairs = self._client.key_value_dir_get(f"{_PREFIX}/fault/")
        faults = {int(key.rpartition("/")[2]): text for key, text in pairs if text}
        self.tell("verdict", "wrong" if faults else "fine")
        if fault is not None:
            raise fault
        if faults:
            first = min(faults)
            raise InputError(f"{self.name(first)}: {faults[first]}")
        return found[0]

    def seen(self, what: str, look: Callable[[], Result | None]) -> Result:
        """What another process has written, as soon as the file system shows it.

        Raises
        ------
        InputError
            If it does not within `PATIENCE`.
        """
        until, pause = time.monotonic() + PATIENCE, 0.01
        while (found := look()) is None:
            if time.monotonic() > until:
                raise InputError(
                    f"{what} is not seen by {self.name(self.index)} after {PATIENCE:g} s; all "
                    "processes must share the file system"
                )
            time.sleep(pause)
            pause = min(2.0 * pause, 1.0)
        return found

    def name(self, index: int) -> str:
        """A process in words."""
        try:
            host = f" on {self._client.key_value_try_get(f'{_PREFIX}/host/{index}')}"
        except Exception:  # it never came so far, or nobody answers
            host = ""
        return f"process {index} of {self.count}{host}"

    def close(self) -> None:
        """Take leave, all having come to their end; process 0 is the last."""
        self._ended = True
        if self.index:
            self.tell(f"left/{self.index}", "")
        elif self.count > 1:
            # Answered as soon as no other is there: who loses the service aborts.
            _waiting(lambda: self._client.get_live_nodes(list(range(self.count))))
            if self._watching.ident is not None:
                self._watching.join()
        jax.distributed.shutdown()

    def _watch(self) -> None:
        while not self._ended:
            time.sleep(_WATCH_S)
            try:
                live = self._client.get_live_nodes(list(range(self.count)))
            except Exception:  # process 0 has ended: JAX ends this one
                return
            gone = [k for k in range(self.count) if k not in live and not self._left(k)]
            if gone and not self._ended:
                self.desert(f"{self.name(gone[0])} has ended", speak=self.index == min(live))

    def _left(self, index: int) -> bool:
        try:
            self._client.key_value_try_get(f"{_PREFIX}/left/{index}")
        except Exception:  # there is no such word
            return False
        return True

    def desert(self, why: str, *, speak: bool = True) -> None:
        """End this process at once; finished batches are kept."""
        for one in self.leaving:
            one()
        if speak:
            print(f"diffopt: {why}: {KEPT}", file=sys.stderr, flush=True)
        os._exit(DESERTED)


def joined(
    coordinator: str | None = None,
    count: int | None = None,
    index: int | None = None,
    *,
    watched: bool = True,
    patience: int = 300,
    heartbeat: int = 20,
) -> Company:
    """Join the processes of a run, before anything is computed.

    Parameters
    ----------
    coordinator
        HOST:PORT at which process 0 listens; by itself under SLURM, Open MPI and the like.
    count, index
        Of the processes, and of this one; likewise.
    watched
        Whether to end when another process has; else somebody else sees to that.
    patience
        Seconds in which all must come.
    heartbeat
        Seconds without a sign of life after which a process counts as dead.

    Raises
    ------
    InputError
        If they do not come, or nothing says who they are.
    """
    # A signal to end is one; the others are not to be aborted because one process has ended.
    jax.config.update("jax_enable_preemption_service", False)
    jax.config.update("jax_enable_recoverability", True)
    logging.getLogger("jax._src.distributed").setLevel(logging.ERROR)
    local = coordinator is not None and coordinator.startswith("127.0.0.1:")
    explicit = None not in (coordinator, count, index)
    try:
        jax.distributed.initialize(
            coordinator,
            count,
            index,
            cluster_detection_method="deactivate" if explicit else None,
            initialization_timeout=patience,
            heartbeat_timeout_seconds=heartbeat,
            coordinator_bind_address=coordinator if local else None,
        )
    except ValueError as error:
        raise InputError(
            f"nothing says which processes belong together ({error}); give --coordinator "
            "HOST:PORT, --processes and --process, or start with srun"
        ) from None
    except RuntimeError as error:
        words = str(error).split("\n")[0][:200]
        raise InputError(f"the processes of the run did not find each other: {words}") from None
    state = _state()
    company = Company(state.process_id, state.num_processes, state.client, watched)
    _own_devices(state)
    return company


def _state() -> Any:
    # Barriers and words of the service have no public name.
    from jax._src import distributed

    return distributed.global_state


def _own_devices(state: Any) -> None:
    """Let JAX make its devices as in a process that is alone.

    Programs are then the same in all processes, and no two wait for each other in them.
    """
    held = state.client, state.num_processes, state.process_id
    state.client, state.num_processes, state.process_id = None, 1, 0
    try:
        jax.local_devices()
    finally:
        state.client, state.num_processes, state.process_id = held


def _waiting(work: Callable[[], Result]) -> Result:
    """The result of something that waits in another language, open to Ctrl-C meanwhile."""
    found: list[Result] = []
    wrong: list[BaseException] = []

    def one() -> None:
        try:
            found.append(work())
        except BaseException as error:
            wrong.append(error)

    thread = threading.Thread(target=one, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(0.5)
    if wrong:
        words = str(wrong[0]).split("\n")[0][:200]
        raise DesertedError(f"another process of the run has ended: {KEPT} ({words})")
    return found[0]
