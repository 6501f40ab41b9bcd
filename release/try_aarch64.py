"""Run the tests marked `portable` on aarch64, emulated: `python release/try_aarch64.py`.

Fetches Debian's Python and wheels of the pinned versions for aarch64 into build/aarch64, installs nothing,
and runs the tests under qemu-aarch64 (Debian: apt-get install qemu-user). Kernels are compiled in
the emulator, too, which takes half an hour of one core; they are kept in the folder. Arguments go to
pytest: `python release/try_aarch64.py tests/test_pipeline.py`.

On an aarch64 machine it is `pytest -m portable`.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "build" / "aarch64"
SYSTEM, PACKAGES, PYTHON = FOLDER / "system", FOLDER / "packages", FOLDER / "python"
LIBRARIES = ("python3", "libstdc++6", "libatomic1")
EXTRAS = ("io", "realtime", "web")
TOOLS = ("hypothesis", "pytest", "pytest-timeout")
LIMIT_S = 7200
"""Of one test: the first that needs a kernel compiles it."""
PATIENCE = 20
"""How many times longer than usual a test waits for another process."""


def main() -> None:
    """Fetch what is not there yet, and run."""
    missing = [name for name in ("apt-get", "dpkg", "qemu-aarch64") if shutil.which(name) is None]
    if missing:
        sys.exit(f"try_aarch64: expected Debian with qemu-user, found no {', '.join(missing)}")
    if not SYSTEM.is_dir():
        print("fetching Debian's Python for aarch64 ...", flush=True)
        fetch_system()
    python = next((SYSTEM / "usr/bin").glob("python3.*"))
    if not PACKAGES.is_dir():
        print("fetching wheels for aarch64 ...", flush=True)
        fetch_packages(python.name.removeprefix("python"))
    write_wrapper(python)
    options = ["-m", "portable", "-p", "no:cacheprovider", "-o", f"timeout={LIMIT_S}", "--durations=20"]
    options += ["-o", f"testpaths={' '.join(portable_files())}"]
    command = [str(PYTHON), "-m", "pytest", *options, *sys.argv[1:]]
    sys.exit(subprocess.run(command, cwd=ROOT).returncode)


def portable_files() -> list[str]:
    """Return the files of tests marked `portable`: others may need packages that are not fetched."""
    files = (ROOT / "tests").rglob("test_*.py")
    return sorted(str(file.relative_to(ROOT)) for file in files if "mark.portable" in file.read_text("utf-8"))


def fetch_system() -> None:
    """Unpack Debian's Python for aarch64, with the libraries that it and the wheels need."""
    apt, archives = FOLDER / "apt", FOLDER / "archives"
    for folder in (apt / "lists/partial", apt / "cache/archives/partial", archives):
        folder.mkdir(parents=True, exist_ok=True)
    options = {
        "APT::Architecture": "arm64",
        "APT::Architectures": "arm64",
        "APT::Sandbox::User": "root",
        "Dir::State::Lists": apt / "lists",
        "Dir::State::status": os.devnull,
        "Dir::Cache": apt / "cache",
    }
    command = [
        "apt-get",
        "-qq",
        *(part for name, value in options.items() for part in ("-o", f"{name}={value}")),
    ]
    run([*command, "update"])
    wanted = run([*command, "install", "--simulate", "--no-install-recommends", *LIBRARIES])
    names = [line.split()[1] for line in wanted.splitlines() if line.startswith("Inst ")]
    run([*command, "download", *names], archives)
    unpacked = SYSTEM.with_suffix(".part")
    for archive in archives.glob("*.deb"):
        run(["dpkg", "-x", str(archive), str(unpacked)])
    unpacked.rename(SYSTEM)


def fetch_packages(version: str) -> None:
    """Unpack the wheels of the pinned versions for aarch64."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wheels, unpacked = FOLDER / "wheels", PACKAGES.with_suffix(".part")
    platforms = ("manylinux2014_aarch64", "manylinux_2_27_aarch64", "manylinux_2_28_aarch64")
    options = [
        "--python-version",
        version,
        "--implementation",
        "cp",
        "--only-binary=:all:",
        "--dest",
        str(wheels),
    ]
    options += [part for platform in platforms for part in ("--platform", platform)]
    options += ["--constraint", str(ROOT / "constraints.txt")]
    wanted = [*project["dependencies"], *TOOLS]
    wanted += [name for extra in EXTRAS for name in project["optional-dependencies"][extra]]
    wanted = [name for name in wanted if not name.startswith("faintspot")]
    run([sys.executable, "-m", "pip", "download", *options, *wanted])
    for wheel in wheels.glob("*.whl"):
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(unpacked)
    unpacked.rename(PACKAGES)


def write_wrapper(python: Path) -> None:
    """Write what stands for Python in the emulator, also for the processes that tests start."""
    lines = (
        "#!/bin/sh",
        f"export PYTHONHOME='{SYSTEM}/usr' PYTHONPATH='{ROOT}/src:{PACKAGES}' PYTHONDONTWRITEBYTECODE=1",
        f"export NUMBA_CACHE_DIR='{FOLDER}/kernels' OPENBLAS_NUM_THREADS=1 FAINTSPOT_PATIENCE={PATIENCE}",
        f"exec qemu-aarch64 -L '{SYSTEM}' -0 '{PYTHON}' '{python}' \"$@\"",
    )
    text = "\n".join(lines) + "\n"
    if not PYTHON.exists() or PYTHON.read_text(encoding="utf-8") != text:  # another run may be using it
        PYTHON.write_text(text, encoding="utf-8")
        PYTHON.chmod(0o755)


def run(command: list[str], folder: Path = ROOT) -> str:
    """Run a command and return what it prints."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)}\nended with {done.returncode}:\n{done.stdout}{done.stderr}")
    return done.stdout


if __name__ == "__main__":
    main()
