"""Build wheel and sdist, check them, and try the wheel as users install it: `make release`.

Every environment is new, and the commands run in an empty folder. `--extras none,io` and `--pythons
python3.12` choose what is tried; by default everything, with every Python from 3.11 to 3.14 that is at hand.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NOT_TRIED = ("oopao", "specula", "soapy", "pyrtc")
"""Extras that bring another tool, with pins of its own."""
FRAME = "import numpy as np; from faintspot.data import mmt_frame; np.save('frame.npy', mmt_frame())"
COMMANDS = (
    "--version",
    "demo --frames 20",
    "layout frame.npy -o found.toml --mask-hot-pixels",
    "slopes frame.npy --config found.toml -o slopes.npz",
    "tune --read-noise-e 3 --pixels 8 --fwhm-px 1.8 --flux-e 200 -o tuned.toml",
)


def main() -> None:
    """Build, check, install and try."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [name for name in project["optional-dependencies"] if name not in NOT_TRIED]
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--extras", default=",".join(["none", *extras]))
    parser.add_argument("--pythons", default=",".join(f"python3.{minor}" for minor in range(11, 15)))
    chosen = parser.parse_args()
    wheel = built()
    rows = []
    for python in filter(_runs, chosen.pythons.split(",")):
        for extra in chosen.extras.split(","):
            rows.append(tried(python, extra, wheel))
            print(rows[-1], flush=True)
    print("", f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB", "", sep="\n")
    print("python, extra, MB installed, seconds of all commands", *rows, sep="\n")


def built() -> Path:
    """Build both packages and have twine check them; return the wheel."""
    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    _run([sys.executable, "-m", "build", "--outdir", "dist", "."], ROOT)
    packages = sorted((ROOT / "dist").iterdir())
    _run([sys.executable, "-m", "twine", "check", "--strict", *map(str, packages)], ROOT)
    return next(path for path in packages if path.suffix == ".whl")


def tried(python: str, extra: str, wheel: Path) -> str:
    """Install the wheel with an extra in an environment of its own, and run every command."""
    with tempfile.TemporaryDirectory(prefix="faintspot-release-") as folder:
        environment, empty = Path(folder) / "environment", Path(folder) / "empty"
        empty.mkdir()
        _run([python, "-m", "venv", str(environment)], empty)
        wanted = str(wheel) if extra == "none" else f"{wheel}[{extra}]"
        pinned = ["--quiet", "--constraint", str(ROOT / "constraints.txt")]
        _run([str(environment / "bin/python"), "-m", "pip", "install", *pinned, wanted], empty)
        size = sum(path.lstat().st_size for path in environment.rglob("*") if not path.is_symlink())
        start = time.monotonic()
        _run([str(environment / "bin/python"), "-c", FRAME], empty)
        for command in COMMANDS:
            _run([str(environment / "bin/faintspot"), *command.split()], empty)
        return f"{python}, {extra}, {size / 1e6:.0f}, {time.monotonic() - start:.0f}"


def _runs(python: str) -> bool:
    """Whether a Python is at hand; a name may stand for one that is not installed."""
    found = shutil.which(python)
    return found is not None and subprocess.run([found, "-c", ""], capture_output=True).returncode == 0


def _run(command: list[str], folder: Path) -> None:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(command)}\nended with {done.returncode}:\n{done.stdout}{done.stderr}")


if __name__ == "__main__":
    main()
