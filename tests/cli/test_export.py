"""faintspot export: what is refused, before anything is compiled or written."""

from pathlib import Path

from tests.cli.cli_cases import CONFIGURATION, Commands


def test_library_refuses_in_one_line(run: Commands, tmp_path: Path) -> None:
    toml = tmp_path / "small.toml"
    toml.write_text(CONFIGURATION)
    folder = tmp_path / "library"
    run.refused("export", "library", toml, "-o", folder, "--cpu", "z80", naming=("z80", "x86-64-v3"))
    toml.write_text(f"[layout]\nbin = 2\n{CONFIGURATION}")
    run.refused("export", "library", toml, "-o", folder, naming=("bin", "1"))
    run.refused("export", "library", tmp_path / "none.toml", naming=("none.toml",))
    assert not folder.exists()
