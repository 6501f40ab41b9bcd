"""Every command of README and docs is one that faintspot has, and those that need nothing but frames run."""

import contextlib
import os
import re
import shlex
import shutil
import tomllib
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from click.testing import CliRunner
from tests.test_documentation import PAGES, ROOT

import faintspot as fs
from faintspot.cli import group
from faintspot.data import mmt_frame
from faintspot.slopes.simulate import sensor_frames

BLOCK = re.compile(r"^```(\S*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
IN_TEXT = re.compile(r"`(faintspot [a-z][^`|]*)`")
RUN = {"estimators", "layout", "report", "slopes", "wavefront"}
"""What runs in a second; others take minutes, end never or need another program: their own tests run them."""


def blocks(text: str, *languages: str) -> list[str]:
    """Return the blocks of a page that are in one of the languages."""
    return [block for language, block in BLOCK.findall(text) if language in languages]


def commands(block: str) -> list[list[str]]:
    """Return the words of each line of a block that calls faintspot."""
    lines = [re.sub(r"^\$ ", "", line) for line in block.splitlines()]
    called = [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("faintspot ")]
    return [words[: words.index(">")] if ">" in words else words for words in called]


def parse(words: list[str]) -> None:
    """Find the command and parse its options, without doing anything."""
    command: click.Command = group
    context = click.Context(command, info_name="faintspot", **command.context_settings)
    while isinstance(command, click.Group) and words and not words[0].startswith("-"):
        found = command.get_command(context, words[0])
        assert found is not None, words[0]
        command, words = found, words[1:]
        context = click.Context(command, context, command.name, **command.context_settings)
    command.make_parser(context).parse_args(list(words))


def pages_to_run() -> list[Any]:
    """Return of each page the commands of those blocks that can be run here, `tune` left out."""
    found = []
    for page in PAGES:
        called_in = map(commands, blocks(page.read_text(encoding="utf-8"), "", "sh"))
        can_run = [block for block in called_in if {words[0] for words in block} <= {*RUN, "tune"}]
        called = [words for block in can_run for words in block if words[0] != "tune"]
        if called:
            found.append(pytest.param(called, id=str(page.relative_to(ROOT))))
    return found


def test_commands_and_options_are_there() -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    for block in blocks(text, "", "sh"):
        for words in commands(block):
            parse(words)
    for called in IN_TEXT.findall(BLOCK.sub("", text)):
        with contextlib.suppress(click.BadOptionUsage):  # in a sentence an option may stand without its value
            parse(shlex.split(called)[1:])


def test_toml_is_toml() -> None:
    for page in PAGES:
        for block in blocks(page.read_text(encoding="utf-8"), "toml"):
            tomllib.loads(block)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what pages call their files, of a sensor of 7 x 7 lenslets."""
    from astropy.io import fits

    folder = tmp_path_factory.mktemp("recorded")
    rng = np.random.default_rng(1)
    layout = fs.Layout.grid(
        (7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5, origin=(16, 16), frame_shape=(144, 144)
    )
    electrons, _ = sensor_frames(layout, 4, flux_e=3000.0, rng=rng)
    frames = (electrons / 1.9 + rng.normal(100.0, 2.0, electrons.shape)).astype(np.uint16)
    for name in ("frames", "night", "reference"):
        fits.writeto(folder / f"{name}.fits", frames)
    fits.writeto(folder / "dark.fits", np.full(layout.frame_shape, 100.0))
    fits.writeto(folder / "flat.fits", np.ones(layout.frame_shape))
    fits.writeto(folder / "bad.fits", np.zeros(layout.frame_shape, np.uint8))
    np.save(folder / "frame.npy", mmt_frame())
    np.save(folder / "interaction.npy", rng.normal(0.0, 0.01, (2 * len(layout), 20)))
    run(["layout", str(folder / "frames.fits"), "-o", str(folder / "found.toml")])
    return folder


def run(words: list[str]) -> None:
    """Run a command as the shell does."""
    said = CliRunner().invoke(group, words, catch_exceptions=False)
    assert said.exit_code == 0, said.output


@pytest.mark.slow
@pytest.mark.parametrize("called", pages_to_run())
def test_documented_commands_run(
    called: list[list[str]],
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    """Pictures are drawn on the pages about them."""
    request.getfixturevalue("coarse_pictures" if "guide" in request.node.name else "undrawn_pictures")
    monkeypatch.chdir(shutil.copytree(recorded, tmp_path / "here"))
    if called[0][0] != "layout":
        os.rename("found.toml", "faintspot.toml")
    for words in called:
        run(words)


def test_start_page_saves_a_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (line,) = re.findall(r"^python -c .*", (ROOT / "docs/start.md").read_text(encoding="utf-8"), re.MULTILINE)
    exec(shlex.split(line)[2])
    assert np.load("frame.npy").shape == mmt_frame().shape
