"""Sweeps of scripts/run.py in many processes: same results, same errors, whatever launches the jobs."""

import importlib.util
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from eval.comparison.runs import find_runs

ROOT = Path(__file__).parent.parent
RUN = [sys.executable, str(ROOT / "scripts" / "run.py")]
SYSTEM = ["system=kiss_icp", "sensor=solid_state"]
PLUGINS = {
    "joblib": "hydra_plugins.hydra_joblib_launcher",
    "ray": "hydra_plugins.hydra_ray_launcher",
    "submitit_local": "hydra_plugins.hydra_submitit_launcher",
    "submitit_slurm": "hydra_plugins.hydra_submitit_launcher",
}
EXTRAS = {"submitit_local": "slurm", "submitit_slurm": "slurm"}
WORKERS = {
    "joblib": ["hydra.launcher.n_jobs=2"],
    "ray": [
        "+hydra.launcher.ray.init.num_cpus=2",
        "+hydra.launcher.ray.init.include_dashboard=false",
    ],
}
MEETING = """
_target_: launcher_support.MeetingSource
count: 6
processes: 2
folder: meeting
"""
# What Slurm's sbatch does with an array of jobs, all at once on this machine.
SBATCH = r"""#!/bin/sh
last=$(sed -n 's/^#SBATCH --array=0-\([0-9]*\)%.*/\1/p' "$1")
for task in $(seq 0 "$last"); do
    SLURM_JOB_ID=7$task SLURM_ARRAY_JOB_ID=7 SLURM_ARRAY_TASK_ID=$task SLURM_JOB_NUM_NODES=1 \
    SLURM_JOB_NODELIST=here SLURM_NTASKS=1 SLURM_PROCID=0 SLURM_LOCALID=0 SLURM_NODEID=0 \
        sh "$1" >/dev/null 2>&1 &
done
echo "Submitted batch job 7"
"""
SRUN = r"""#!/bin/bash
while [[ $1 == --* ]]; do
    [[ $1 == --unbuffered ]] && shift || shift 2
done
exec "${@//%j/${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID}"
"""
SACCT = "#!/bin/sh\necho 'JobID|State|NodeList'\n"

pytestmark = pytest.mark.slow


def needs(launcher):
    extra = EXTRAS.get(launcher, launcher)
    return pytest.param(
        launcher,
        marks=pytest.mark.skipif(
            not installed(PLUGINS[launcher]),
            reason=f"the extra {extra} isn't installed: pip install -e .[{extra}]",
        ),
    )


def installed(module):
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False


LAUNCHERS = [needs(launcher) for launcher in PLUGINS]


def sweep(folder, launcher, *arguments):
    """Run a sweep in a folder; return the process that has ended."""
    tools = folder / "slurm"
    tools.mkdir(exist_ok=True)
    for name, text in (("sbatch", SBATCH), ("srun", SRUN), ("sacct", SACCT)):
        (tools / name).write_text(text)
        (tools / name).chmod(stat.S_IRWXU)
    environment = {
        **os.environ,
        "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT / "tests"),
        "OMP_NUM_THREADS": "1",
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_AUTH_MODE": "disabled",
    }
    options = [f"hydra/launcher={launcher}", *WORKERS.get(launcher, [])]
    return subprocess.run(
        [*RUN, *arguments, *options, "-m"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


def meet(folder, launcher, processes):
    """Run two jobs that wait until they are in as many processes, and one that fails."""
    (folder / "conf" / "scenario").mkdir(parents=True)
    (folder / "conf" / "scenario" / "meeting.yaml").write_text(MEETING)
    (folder / "meeting").mkdir()
    settings = [f"scenario.processes={processes}", "scenario.count=4,6,0"]
    return sweep(folder, launcher, "--config-dir", "conf", "scenario=meeting", *SYSTEM, *settings)


def trajectories(folder):
    """Return the trajectory that each job of the only sweep in a folder left, by the job's folder."""
    files = sorted(folder.glob("multirun/*/*/*/trajectory.tum"))
    return {file.parent.name.partition("_")[0]: file.read_bytes() for file in files}


@pytest.fixture(scope="module")
def one_after_the_other(tmp_path_factory):
    folder = tmp_path_factory.mktemp("basic")
    done = meet(folder, "basic", processes=1)
    assert done.returncode == 2, done.stderr
    return trajectories(folder)


@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_jobs_in_processes_of_their_own_leave_what_one_process_would_have(
    launcher, tmp_path, one_after_the_other
):
    done = meet(tmp_path, launcher, processes=2)
    assert done.returncode == 2, done.stderr
    assert "error: no usable scans" in done.stderr
    assert "Traceback" not in done.stderr
    assert len(list((tmp_path / "meeting").iterdir())) >= 2
    assert trajectories(tmp_path) == one_after_the_other
    assert one_after_the_other.keys() == {"0", "1"}
    assert len(list(tmp_path.glob("multirun/*/*/*/metrics.json"))) == 2
    (missing,) = find_runs([tmp_path / "multirun"]).missing
    assert "job 2" in missing.name


@pytest.mark.parametrize("launcher", [needs("joblib")])
def test_two_jobs_that_want_the_same_campaign_record_it_once(launcher, tmp_path):
    coarse = ["scenario.rig=[bosch]", "+scenario.azimuth_steps={bosch: 1.0}", "scenario.speed=16"]
    choice = ["scenario=A", "sensor=bosch", "system=kiss_icp", "seed=0,1"]
    done = sweep(tmp_path, launcher, *choice, *coarse)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("recording A") == 1
    first, second = trajectories(tmp_path).values()
    assert first == second
    assert len(list((tmp_path / ".cache" / "campaigns").glob("A-*"))) == 1
