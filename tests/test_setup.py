"""scripts/setup.sh against stand-ins for the system's tools: what it would install, and when."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LIBRARIES = [
    "EGL.so.1",
    "GL.so.1",
    "X11.so.6",
    "idn2.so.0",
    "stdc++.so.6",
    "udev.so.1",
    "usb-1.0.so.0",
]
# A Python that has venv or not, makes a copy of itself as .venv, and notes what pip is asked for.
PYTHON = """#!/bin/sh
echo "$0 $*" >>"$LOG"
case "$*" in
*"import ensurepip"*) [ "$HAS_VENV" = yes ] ;;
*"version_info[:2] <="*) [ "$GOOD_PYTHON" = yes ] ;;
*"print("*) echo python3.11-venv ;;
--version) echo Python 3.9.2 ;;
"-m venv"*) mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
esac
"""


@pytest.fixture
def setup(tmp_path):
    """Return a function that runs setup.sh in a folder with a stand-in for each tool it calls."""
    project, tools = tmp_path / "project", tmp_path / "tools"
    for folder in (project / "scripts", tools):
        folder.mkdir(parents=True)
    shutil.copy(ROOT / "scripts" / "setup.sh", project / "scripts")
    (project / "pyproject.toml").write_text("one")
    log, essentials = tmp_path / "log", _essentials(tmp_path)

    def tool(name, text):
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)

    def call(libraries=LIBRARIES, root=False, sudo=False, apt=True, chromium=True, **environment):
        log.write_text("")
        listed = "\\n".join(f"\tlib{name} (libc6) => /lib/lib{name}" for name in libraries)
        tool("python3", PYTHON)
        tool("ldconfig", f"#!/bin/sh\nprintf '{listed}\\n'\n")
        tool("id", f"#!/bin/sh\necho {0 if root else 1000}\n")
        allowed = 'shift; [ "$1" = true ] || exec "$@"' if sudo else "exit 1"
        tool("sudo", f"#!/bin/sh\n{allowed}\n")
        if apt:
            tool("apt-get", '#!/bin/sh\necho "apt-get $*" >>"$LOG"\n')
        if chromium:
            tool("chromium", "#!/bin/sh\n")
        defaults = {"HAS_VENV": "yes", "GOOD_PYTHON": "yes", "LOG": str(log)}
        done = subprocess.run(
            [project / "scripts" / "setup.sh"],
            env={**defaults, **environment, "PATH": f"{tools}:{essentials}"},
            capture_output=True,
            text=True,
            timeout=60,
        )
        return done, log.read_text()

    call.project = project
    return call


def _essentials(folder):
    """Return a folder of the few commands that setup.sh and the stand-ins need, and no others."""
    essentials = folder / "essentials"
    essentials.mkdir()
    for name in ("bash", "sh", "env", "dirname", "cat", "cksum", "mkdir", "cp"):
        (essentials / name).symlink_to(shutil.which(name))
    return essentials


def test_installs_once_and_again_when_the_project_changes(setup):
    done, log = setup()
    assert done.returncode == 0
    assert "pip install" in log
    assert "apt-get" not in log
    done, log = setup()
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert "pip" not in log
    (setup.project / "pyproject.toml").write_text("two")
    assert "pip install" in setup()[1]


@pytest.mark.parametrize("rights", [{"root": True}, {"sudo": True}])
def test_installs_what_is_missing_where_it_may(setup, rights):
    done, log = setup(libraries=LIBRARIES[:-1], HAS_VENV="no", **rights)
    assert done.returncode == 0
    (line,) = [line for line in log.splitlines() if line.startswith("apt-get install")]
    assert line.endswith("libusb-1.0-0 python3.11-venv")


def test_names_the_command_where_it_may_not(setup):
    done, log = setup(libraries=LIBRARIES[2:])
    assert done.returncode != 0
    assert done.stderr.strip().endswith("--no-install-recommends libegl1 libgl1")
    assert "sudo apt-get install" in done.stderr
    assert "pip install" not in log


def test_names_the_packages_where_there_is_no_apt(setup):
    done, _ = setup(libraries=LIBRARIES[1:], apt=False)
    assert done.returncode != 0
    assert "install what Debian calls: libegl1" in done.stderr


def test_installs_a_browser_where_it_may(setup):
    done, log = setup(chromium=False, root=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert any(line.endswith(" chromium") for line in log.splitlines())


@pytest.mark.parametrize("apt", [True, False])
def test_goes_on_without_a_browser_and_says_so(setup, apt):
    done, log = setup(chromium=False, apt=apt)
    assert done.returncode == 0
    assert "chromium" in done.stderr
    assert "will be skipped" in done.stderr
    assert "pip install" in log


def test_says_which_pythons_will_do(setup):
    done, _ = setup(GOOD_PYTHON="no")
    assert done.returncode != 0
    assert "needs Python 3.11, 3.12 or 3.13; python3 is Python 3.9.2" in done.stderr


def test_make_lists_its_targets():
    done = subprocess.run(["make"], cwd=ROOT, capture_output=True, text=True, check=True)
    for target in ("setup", "run", "test", "lint"):
        assert f"make {target} " in done.stdout


def test_ci_runs_the_tests_as_the_readme_says():
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    assert "make test" in script.read_text()
