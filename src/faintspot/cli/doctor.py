"""faintspot doctor: what is installed and what the machine allows."""

from __future__ import annotations

import json
from dataclasses import asdict

import click

from faintspot.cli.examination import examine
from faintspot.cli.shared.commands import option


@click.command(short_help="Say what is installed, what this machine allows, and what to do.")
@option("--json", "as_json", is_flag=True, help="As JSON: name, value and advice of each finding.")
def command(as_json: bool) -> None:
    """Check the installation and this machine, and say how to add what is missing.

    Versions, extras, processor and vector width, folder of compiled kernels, threads, shared memory and
    real-time permissions. Nothing of it is an error: most of faintspot needs no extra and no permission. Put
    its output into a report of a fault.

    \b
    Examples:
      faintspot doctor
      faintspot doctor --json > doctor.json
    """
    findings = examine()
    if as_json:
        click.echo(json.dumps([asdict(finding) for finding in findings], indent=1))
        return
    for finding in findings:
        click.echo(f"{finding.name:14s} {finding.value}")
        if finding.advice is not None:
            click.echo(f"{'':14s} -> {finding.advice}")
