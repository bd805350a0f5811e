"""Packages of production: pinned as in constraints.txt, each file by its hash, in the bill of materials."""

import re
from pathlib import Path

from tools.audit import verdict
from tools.sbom import bill, pins

ROOT = Path(__file__).parents[1]
REQUIREMENTS = (ROOT / "deploy" / "requirements.lock").read_text(encoding="utf-8")


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_package_has_hashes_and_the_version_of_the_constraints():
    constraints = {
        normal(name): version
        for name, version in re.findall(
            r"^([\w.-]+)==(\S+)", (ROOT / "constraints.txt").read_text("utf-8"), re.MULTILINE
        )
    }
    found = pins(REQUIREMENTS)
    assert [name for name, (_, hashes) in found.items() if not hashes] == []
    assert {normal(name): version for name, (version, _) in found.items()}.items() <= constraints.items()


def test_actions_and_the_base_image_are_named_by_their_content():
    used = [
        f for path in (ROOT / ".github" / "workflows").iterdir() for f in re.findall(r"uses: (\S+)", path.read_text())
    ]
    assert [action for action in used if not re.search("@[0-9a-f]{40}$", action)] == []
    (base,) = re.findall(r"^FROM (\S+)", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    assert re.search("@sha256:[0-9a-f]{64}$", base)


def test_no_command_of_an_installation_fetches_what_has_no_hash():
    pages = [ROOT / "Dockerfile", *(ROOT / "docs").rglob("*.md")]
    lines = [
        line
        for page in pages
        for line in page.read_text("utf-8").splitlines()
        if "install --no-deps " in line or "--no-cache-dir --no-deps" in line
    ]
    assert len(lines) == 4
    assert [line for line in lines if not re.search("--require-hashes -r|--no-build-isolation", line)] == []
    assert "setuptools" in pins(REQUIREMENTS)


def test_every_dependency_is_among_them():
    project = (
        (ROOT / "pyproject.toml").read_text(encoding="utf-8").partition("\ndependencies = [")[2].partition("\n]")[0]
    )
    needed = {normal(name) for name in re.findall(r'^    "([\w.-]+)', project, re.MULTILINE)}
    assert len(needed) > 10
    assert needed <= {normal(name) for name in pins(REQUIREMENTS)}


def test_the_bill_of_materials_lists_all_packages():
    components = bill(REQUIREMENTS)["components"]
    assert {(part["name"], part["version"]) for part in components} == {
        tuple(line.split(" ")[0].split("==")) for line in REQUIREMENTS.splitlines() if re.match(r"\w", line)
    }


def test_a_package_that_was_not_looked_up_is_not_taken_for_a_good_one():
    good = {"name": "good", "version": "1", "vulns": []}
    bad = {"name": "bad", "version": "2", "vulns": [{"id": "CVE-1"}]}
    assert verdict({"dependencies": [good]}) == (True, ["no known vulnerabilities in 1 packages"])
    assert verdict({"dependencies": [good, bad]}) == (False, ["bad 2: CVE-1"])
    skipped = {"name": "odd", "skip_reason": "not found"}
    assert verdict({"dependencies": [good, skipped]}) == (
        False,
        ["NOT CHECKED: 1 of 2 packages could not be looked up"],
    )
    assert not verdict({"dependencies": []})[0]
