"""The README says what works: its commands and its Python are run, on a small dataset in place of the big one."""

import re
import shlex
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import pytest
from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from stickslip.workflows.commands import main

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()
LOCK = ROOT / "requirements-dev.lock"


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.DOTALL | re.MULTILINE)


COMMANDS = [
    line.removeprefix(".venv/bin/")
    for block in blocks("sh")
    for line in block.splitlines()
    if line.startswith(".venv/bin/stickslip")
]


def test_a_newcomer_needs_two_commands():
    setup = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("python3 -m venv")]
    assert len(setup) == 2
    assert "stickslip run cascades" in setup[0]
    assert setup[1].endswith("python -m pytest -n 2")


def test_the_citation_has_the_version():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


def unmet(platform):
    """What `stickslip[dev]` needs on a platform, all the way down, and requirements-dev.lock does not hold."""
    environment = default_environment() | platform
    pins = [Requirement(line) for line in LOCK.read_text().splitlines() if not line.startswith("#")]
    pinned = {
        canonicalize_name(pin.name): next(iter(pin.specifier)).version
        for pin in pins
        if pin.marker is None or pin.marker.evaluate(environment)
    }
    pinned["stickslip"] = distribution("stickslip").version
    missing, seen, waiting = [], set(), [Requirement("stickslip[dev]")]
    while waiting:
        need = waiting.pop()
        if str(need) in seen:
            continue
        seen.add(str(need))
        name = canonicalize_name(need.name)
        if name not in pinned or not need.specifier.contains(pinned[name], prereleases=True):
            missing.append(str(need))
            continue
        try:
            package = distribution(name)
        except PackageNotFoundError:
            continue  # of another platform
        extras = {canonicalize_name(extra) for extra in package.metadata.get_all("Provides-Extra", [])}
        missing += [f"{name}[{extra}]" for extra in need.extras if canonicalize_name(extra) not in extras]
        for further in map(Requirement, package.requires or []):
            marker = further.marker
            if marker is None or any(marker.evaluate(environment | {"extra": extra}) for extra in ("", *need.extras)):
                waiting.append(further)
    return missing


@pytest.mark.parametrize("version", ["3.11", "3.14"])
@pytest.mark.parametrize("system", ["Linux", "Darwin"])
def test_the_lock_is_whole(version, system):
    """For it is installed without resolving. What a package needs is read from the version that is installed here."""
    platform = {"python_version": version, "python_full_version": f"{version}.2"}
    platform |= {"platform_system": system, "sys_platform": system.lower()}
    assert unmet(platform) == []


def test_commands(dataset, small_scene, tmp_path, monkeypatch, capsys):
    """In the order of the page; the scene that `init` writes is replaced by a smaller one before it is run."""
    monkeypatch.chdir(tmp_path)
    said = [shlex.split(command) for command in COMMANDS]
    assert {argv[1] for argv in said} == {"init", "run", "query"}
    for argv in said:
        assert argv[0] == "stickslip"
        assert main([{"runs/cascades": str(dataset)}.get(word, word) for word in argv[1:]]) == 0, argv
        assert capsys.readouterr().out.strip()
        if argv[1] == "init":
            (tmp_path / argv[2]).write_text(small_scene.read_text())


@pytest.mark.parametrize("number", range(len(blocks("python"))))
def test_python(number, dataset):
    code = blocks("python")[number].replace("runs/cascades", str(dataset))
    exec(compile(code, f"README.md, block {number + 1}", "exec"), {})
