"""Precomputation by several processes: the store of one, kills, clusters."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time

import jax.numpy as jnp
import numpy as np
import pytest
from killing import content
from lengths import but
from test_transfer_store import FILE

from diffopt.cli import main
from diffopt.errors import InputError
from diffopt.transfer import distributed, store
from diffopt.transfer.distributed import Company

LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")
WORDS = ["--rays", "64", "--finest", "1", "--splits", "1", "--tolerance", "0.15"]
WORDS += ["--compression", "0"]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "ring.toml"
    path.write_text(FILE)
    return path


@pytest.fixture(scope="module")
def whole(file, tmp_path_factory):
    """The store of one process."""
    path = tmp_path_factory.mktemp("one") / "ring.zarr"
    assert main(["precompute", str(file), "-o", str(path), *WORDS, "--quiet"]) == 0
    assert len(store.load(path).rounds) > 1
    return path


def begun(file, path, *words, **environment):
    wide = {"JAX_ENABLE_X64": str(int(jnp.ones(()).dtype == jnp.float64))}
    return subprocess.Popen(
        [sys.executable, "-m", "diffopt", "precompute", str(file), "-o", str(path), *WORDS, *words],
        env=os.environ | wide | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def children(parent):
    """Numbers of the processes that one has started, in their order."""
    with open(f"/proc/{parent}/task/{parent}/children") as file:
        return [int(word) for word in file.read().split()]


def kept(path):
    return len(list(path.glob("working/[0-9]*.npz")))


def until(true, limit=60.0):
    end = time.monotonic() + limit
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def under_slurm(file, path, port):
    """Two processes as srun starts them, on this machine."""
    common = {
        "SLURM_JOB_ID": "1",
        "SLURM_STEP_NODELIST": "127.0.0.1",
        "SLURM_NTASKS": "2",
        "SLURM_STEP_NUM_NODES": "1",
        "JAX_COORDINATOR_PORT": str(port),
    }
    numbers = [{"SLURM_PROCID": k, "SLURM_LOCALID": k} for k in ("0", "1")]
    return [begun(file, path, "--distributed", **common, **one) for one in numbers]


@LINUX
@pytest.mark.parametrize("how", but({"in one process"}, ["in one process", "under slurm"]))
def test_a_killed_process_ends_the_run_which_goes_on(how, file, whole, tmp_path, capfd):
    path = tmp_path / "ring.zarr"
    run = begun(file, path, "--processes", "2")
    try:
        until(lambda: kept(path) > 1 and len(children(run.pid)) == 2)
        capfd.readouterr()
        # The lock is that of the run.
        assert main(["precompute", str(file), "-o", str(path), *WORDS]) == 2
        assert f"process {run.pid} on" in capfd.readouterr().err
        workers = children(run.pid)
        os.kill(workers[1], signal.SIGKILL)
        at = time.monotonic()
        _, err = run.communicate(timeout=20)
        # Seconds, where nobody waits for the heartbeats of the dead.
        assert time.monotonic() - at < 10.0
    finally:
        run.kill()
    assert run.returncode == 1
    assert f"process 1 of 2 (pid {workers[1]}) was killed" in err
    assert "finished batches are kept, and the same command goes on from them" in err
    assert len(err.splitlines()) == 1
    assert not [pid for pid in workers if os.path.exists(f"/proc/{pid}")]
    assert store.state(path) == "begun"
    before = kept(path)
    assert before > 1
    if how == "under slurm":
        runs = under_slurm(file, path, free_port())
        said = [one.communicate(timeout=120) for one in runs]
        assert [one.returncode for one in runs] == [0, 0], said
        # Process 0 alone speaks.
        assert said[1][0] == ""
        told = said[0][0]
    else:
        assert main(["precompute", str(file), "-o", str(path), *WORDS]) == 0
        told = capfd.readouterr().out
    assert f"goes on from {before} batches" in told
    assert content(path) == content(whole)
    # By the clock of all runs, not of all processes.
    record = store.record_of(path)
    assert record["seconds"] < 120.0


@LINUX
@pytest.mark.long
@pytest.mark.parametrize("victim", ["0", "parent", "interrupted"])
def test_whoever_ends_nothing_is_left_running(victim, file, whole, tmp_path):
    path = tmp_path / "ring.zarr"
    run = begun(file, path, "--processes", "2")
    until(lambda: kept(path) > 1 and len(children(run.pid)) == 2)
    workers = children(run.pid)
    if victim == "0":
        os.kill(workers[0], signal.SIGKILL)
    else:
        run.send_signal(signal.SIGKILL if victim == "parent" else signal.SIGINT)
    out, err = run.communicate(timeout=20)
    assert run.returncode == {"0": 1, "parent": -signal.SIGKILL, "interrupted": 130}[victim]
    if victim == "0":
        assert f"process 0 of 2 (pid {workers[0]}) was killed" in err
    if victim == "interrupted":
        assert "the same command goes on from there" in out
    until(lambda: not [pid for pid in workers if os.path.exists(f"/proc/{pid}")], 15.0)
    # With another number of processes, more than there are batches at the end.
    assert begun(file, path, "--processes", "3", "--quiet").wait(120) == 0
    assert content(path) == content(whole)


@LINUX
@pytest.mark.long
def test_twenty_kills_of_three_processes(file, whole, tmp_path):
    rng = np.random.default_rng(20140113)
    path, number, done = tmp_path / "0.zarr", 0, 0
    while done < 20:
        run = begun(file, path, "--processes", "3", "--quiet")
        pids = []
        end = time.monotonic() + rng.uniform(2.0, 14.0)
        while time.monotonic() < end and run.poll() is None:
            pids = children(run.pid) or pids
            time.sleep(0.02)
        if run.poll() is None and pids:
            os.kill([*pids, run.pid][rng.integers(len(pids) + 1)], signal.SIGKILL)
            done += 1
        _, err = run.communicate(timeout=60)
        until(lambda p=pids: not [pid for pid in p if os.path.exists(f"/proc/{pid}")], 15.0)
        assert run.returncode in (0, 1, -signal.SIGKILL), err
        if run.returncode == 0:
            assert content(path) == content(whole)
            number += 1
            path = tmp_path / f"{number}.zarr"
    assert begun(file, path, "--processes", "3", "--quiet").wait(120) == 0
    assert content(path) == content(whole)


def test_faults_are_told_once_before_anything_starts(file, tmp_path, capsys):
    several = ["--processes", "2"]
    path = str(tmp_path / "a.zarr")
    for words, text in [
        (["no.toml", "-o", path, *several], "no.toml: no such file"),
        ([str(file), "-o", path, *several, "--rays", "3"], "--rays must be a whole number"),
        ([str(file), "-o", path, "--processes", "0"], "--processes must lie between 1 and 256"),
        ([str(file), "-o", path, "--process", "1"], "--process needs --coordinator"),
        ([str(file), "-o", path, "--coordinator", "a", *several], "must be HOST:PORT"),
        ([str(file), "-o", path, "--coordinator", "a:1", *several], "needs --processes and"),
        (
            [str(file), "-o", path, "--coordinator", "a:1", *several, "--process", "2"],
            "--process must lie between 0 and 1",
        ),
        ([str(file), "-o", path, "--distributed", *several], "give it alone"),
    ]:
        assert main(["precompute", *words]) == 2
        err = capsys.readouterr().err
        assert text in err
        assert len(err.splitlines()) == 1
    assert not (tmp_path / "a.zarr").exists()


class Service:
    """Words and barriers of several threads, in place of the service of JAX."""

    def __init__(self, count):
        self.words, self.barriers, self.count = {}, {}, count
        self.guard = threading.Condition()

    def key_value_set(self, key, value):
        with self.guard:
            assert key not in self.words
            self.words[key] = value
            self.guard.notify_all()

    def blocking_key_value_get(self, key, _):
        with self.guard:
            self.guard.wait_for(lambda: key in self.words, 10.0)
            return self.words[key]

    def key_value_try_get(self, key):
        return self.words[key]

    def key_value_dir_get(self, key):
        return [(name, text) for name, text in self.words.items() if name.startswith(key)]

    def wait_at_barrier(self, name, _):
        with self.guard:
            barrier = self.barriers.setdefault(name, threading.Barrier(self.count, timeout=10.0))
        barrier.wait()


def each_of(count, work):
    """What processes return or raise, by threads."""
    service, found = Service(count), {}

    def one(index):
        company = Company(index, count, service, watched=False)
        try:
            found[index] = work(company)
        except (InputError, SystemExit) as error:
            found[index] = error

    threads = [threading.Thread(target=one, args=(k,)) for k in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [found[k] for k in range(count)]


def test_another_decision_is_told():
    def work(company):
        company.agreed("what to split", np.arange(3) + (company.index == 2))

    found = each_of(3, work)
    assert found[:2] == [None, None]
    assert "process 2 of 3" in str(found[2])
    assert "something else than process 0: what to split" in str(found[2])


def test_the_first_fault_is_told_by_process_0():
    def work(company):
        def look():
            if company.index:
                raise InputError(f"fault {company.index}")
            return 7

        return company.alike(look)

    found = each_of(3, work)
    assert isinstance(found[0], InputError)
    assert str(found[0]).startswith("process 1 of 3")
    assert str(found[0]).endswith(": fault 1")
    assert all(isinstance(one, SystemExit) for one in found[1:])
    assert each_of(2, lambda company: company.alike(lambda: company.index)) == [0, 1]


def test_a_slow_file_system_is_waited_for(monkeypatch):
    """Not for ever."""
    (company,) = each_of(1, lambda company: company)
    times = iter([None, None, "batch"])
    assert company.seen("batch 3", lambda: next(times)) == "batch"
    monkeypatch.setattr(distributed, "PATIENCE", 0.05)
    with pytest.raises(InputError, match=r"batch 3 is not seen by process 0 of 1.*file system"):
        company.seen("batch 3", lambda: None)


def test_clocks_of_processes_run_side_by_side(file, tmp_path):
    import diffopt as do
    from diffopt.scenes import Object, Plane, Scene
    from diffopt.transfer.precomputation import precompute
    from diffopt.transfer.settings import TransferSettings
    from diffopt.transfer.working import Working

    scene = Scene([Object(Plane(2.0, 2.0), do.BlinnPhong(0.5, 16.0))])
    settings = TransferSettings(rays=64, finest=1, splits=0)

    class Memory(dict):
        load = dict.get
        save = dict.__setitem__

    precompute(scene, settings, batches=(batch := Memory()))
    path = store.begin(tmp_path / "a.zarr")
    for k, name in enumerate(["a/0", "a/1", "b"]):
        with Working(path, scene, settings, session=name) as working:
            working._clock -= 100.0
            working._cpu -= 10.0
            working.save(k, batch[0])
    with Working(path, scene, settings, session="c/0") as working:
        assert all(working.load(k) is not None for k in range(3))
        clock, cpu = working.spent
    # 100 s each of two runs, of which one had two processes.
    assert clock == pytest.approx(200.0, abs=5.0)
    assert cpu == pytest.approx(30.0, abs=5.0)
