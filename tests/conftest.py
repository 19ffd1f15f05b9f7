"""What all tests share: options, and which optional checks this machine can run."""

import os
import signal
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

# There are as many processes as cores: BLAS threads in each process would compete for them.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Threads of numba's loops sleep until they have work: spinning takes the other process's core.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np
import pytest
from programs import exit_code

from emmc_rig.model.camera import Camera, build_imaging_matrix
from emmc_rig.model.sensing import Psi

# A script's background job ignores Ctrl-C, and so would every program that a test starts.
signal.signal(signal.SIGINT, signal.default_int_handler)

pytest.register_assert_rewrite(
    "emmc_rig.bench.conformance.cameras", "emmc_rig.bench.conformance.stages"
)


def pytest_addoption(parser):
    parser.addoption(
        "--stage", help="a real stage for tests marked hardware: zaber:/dev/ttyUSB0, or a YAML file"
    )
    parser.addoption("--camera", help="a real camera for tests marked hardware: ptp:SERIAL")
    parser.addoption("--all", action="store_true", help="the slow tests, too, as CI does")
    parser.addoption("--list-run", type=Path, help="file to write: the tests that were run")
    parser.addoption("--but", type=Path, help="leave out what such a file lists")


def tests_are_named(config):
    return config.args_source != config.ArgsSource.TESTPATHS


def pytest_configure(config):
    if not hasattr(config, "workerinput") and tests_are_named(config):
        config.option.all = True  # workers get the options, and do not know what was named


def pytest_xdist_auto_num_workers(config):
    """Return the cores for a run of everything; a real device, or tests named, get one process."""
    real = config.getoption("--stage") or config.getoption("--camera")
    return 0 if tests_are_named(config) or real else os.cpu_count()


def pytest_sessionstart(session):
    """Compile what most tests need once, before the workers begin: each would compile it again."""
    config = session.config
    if hasattr(config, "workerinput") or tests_are_named(config) or config.option.collectonly:
        return
    if config.option.but is not None:  # the run that listed those tests has compiled
        return
    first_run = [sys.executable, "-m", "emmc_rig.commands.first_run"]
    for together in (("search", "fit"), ("dict-admm",)):
        with ExitStack() as running:
            processes = [
                running.enter_context(
                    # It ends when its input does: this process's own may be at its end already.
                    subprocess.Popen([*first_run, part, "rgbw-bayer-3shots"], stdin=subprocess.PIPE)
                )
                for part in together
            ]
            if any(process.wait() for process in processes):
                pytest.exit(f"kernels of {' or '.join(together)} do not compile or run", 1)


NO_LIGHT_FIELDS = "EMMC_LIGHTFIELDS does not name a folder of real light fields"


def pytest_collection_modifyitems(config, items):
    if config.getoption("--but") is not None:
        listed = set(config.getoption("--but").read_text(encoding="utf-8").splitlines())
        items[:] = [item for item in items if item.nodeid not in listed]
    if not config.getoption("--all"):
        slow = [item for item in items if "slow" in item.keywords]
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if "slow" not in item.keywords]
    folder = os.environ.get("EMMC_LIGHTFIELDS")
    skips = {}
    if not (folder and Path(folder).is_dir()):
        skips["real_data"] = NO_LIGHT_FIELDS
    for item in items:
        for marker, reason in skips.items():
            if marker in item.keywords:
                item.add_marker(pytest.mark.skip(reason=reason))
        if "hardware" in item.keywords:
            device = "camera" if "camera_kind" in item.fixturenames else "stage"
            if not config.getoption(f"--{device}"):
                reason = f"no real {device}: name one with --{device}"
                item.add_marker(pytest.mark.skip(reason=reason))


def pytest_terminal_summary(terminalreporter):
    """Name the checks that ran on real light fields, or say why none of those chosen did."""
    path = terminalreporter.config.getoption("--list-run")
    if path is not None:
        run = [r for name in ("passed", "failed") for r in terminalreporter.stats.get(name, [])]
        path.write_text("".join(f"{report.nodeid}\n" for report in run), encoding="utf-8")
    reported = {
        outcome: [
            report.nodeid
            for report in terminalreporter.stats.get(outcome, [])
            # Modules that are skipped as a whole have none.
            if "real_data" in getattr(report, "keywords", ())
        ]
        for outcome in ("passed", "failed", "error", "skipped")
    }
    skipped = reported.pop("skipped")
    ran = [f"{outcome}: {name}" for outcome, names in reported.items() for name in names]
    if ran or skipped:
        terminalreporter.section("real light fields")
        why = "" if ran else f": {NO_LIGHT_FIELDS}"
        terminalreporter.write_line(f"{len(ran)} checks ran on real light fields{why}")
        for line in ran:
            terminalreporter.write_line(line)
    absent = [
        report
        for report in terminalreporter.stats.get("skipped", [])
        if "peers" in getattr(report, "keywords", ())
    ]
    if absent:
        terminalreporter.section("independent programs")
        terminalreporter.write_line(f"{len(absent)} checks were skipped; -rs says what is absent")


@pytest.fixture
def peer_files():
    """The folder of files of real devices, named by EMMC_PEER_FILES."""
    folder = os.environ.get("EMMC_PEER_FILES")
    if not (folder and Path(folder).is_dir()):
        pytest.skip("EMMC_PEER_FILES does not name a folder of files of real devices")
    return Path(folder)


@pytest.fixture(scope="module")
def memory_folder():
    """A folder in memory where there is one: a kill loses no bytes that a disk was given."""
    memory = Path("/dev/shm")
    where = memory if os.access(memory, os.W_OK) else None
    with tempfile.TemporaryDirectory(dir=where) as folder:
        yield Path(folder)


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Run the program in a folder of its own: exit code, standard output and standard error."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        code = exit_code(*arguments)
        shown = capsys.readouterr()
        return code, shown.out, shown.err

    return call


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """A headless browser; the module's marks are those of `browsers`."""
    from browsers import open_browser

    with open_browser(tmp_path_factory.mktemp("profile")) as driver:
        yield driver


@pytest.fixture(scope="session")
def random_psi():
    """Return a maker of imaging matrices with random weights and colours."""

    def make(shots=1, views=(2, 3), size=(12, 18), stored=1, binning=1, seed=0):
        rng = np.random.default_rng(seed)
        weights = rng.uniform(0, 1, (shots, *views, size[0], stored, size[1])).astype(np.float32)
        colour = None
        if stored == 1:
            colour = rng.integers(0, 3, (shots, *size), dtype=np.uint8)
            if binning > 1:
                colour = colour[:, ::binning, ::binning].repeat(binning, 1).repeat(binning, 2)
        return Psi(weights, colour, binning)

    return make


@pytest.fixture(scope="session")
def coded_psi():
    """Return a function that makes a small Psi of a random colour mask near the sensor."""

    def made(cfa="rggb", binning=1, shots=1, size=(6, 8), views=(2, 3), dtype=np.float32):
        pattern = {"kind": "random_rgbw", "seed": 0}
        camera = Camera.model_validate(
            {
                "title": "test",
                "views": views,
                "sensor": {"cfa": cfa, "binning": binning},
                "masks": {"m": {"distance_mm": 0.24, "cell_um": 24.0, "pattern": pattern}},
                "more_shots_step_um": {"m": (72, 48)},
            }
        )
        psi = build_imaging_matrix(camera.with_shots(shots), size)
        return Psi(psi.weights.astype(dtype), psi.colour, binning, psi.camera_json)

    return made
