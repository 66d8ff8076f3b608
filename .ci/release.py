"""Makes a release: `make release VERSION=x.y.z`, after the section of the changelog has been written.

The version is set in the one place that has it, the wheel and the sdist are built and their metadata checked, and the
result is committed and tagged. Nothing is pushed or uploaded, and a release that fails changes nothing.
"""

import argparse
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

from packaging.metadata import Metadata
from packaging.version import Version

ROOT = Path(__file__).resolve().parents[1]
#: The only place that has the version; setup.cfg reads it there.
VERSIONED = ROOT / "sb3_sap" / "__init__.py"
LINE = re.compile(r'^__version__ = "(.+)"$', re.MULTILINE)


def git(*arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True).stdout.strip()


def section_of(version: str) -> str:
    """The entries of a version in the changelog; empty where there are none."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    heading = rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d\n(.*?)(?=^## |\Z)"
    found = re.search(heading, text, re.MULTILINE | re.DOTALL)
    return found[1].strip() if found and "\n- " in f"\n{found[1]}" else ""


def objection(version: str) -> str | None:
    """Why this version cannot be released now; None where it can."""
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        return f"VERSION must be three numbers such as 1.2.3, but is {version!r}."
    if (current := LINE.findall(VERSIONED.read_text(encoding="utf-8"))[0]) and Version(version) < Version(current):
        return f"{version} is older than the current version, {current}."
    if git("tag", "--list", f"v{version}"):
        return f"The tag v{version} exists already."
    if changes := git("status", "--porcelain"):
        return f"The working tree has uncommitted changes: commit or remove them first.\n{changes}"
    if not section_of(version):
        return f"CHANGELOG.md has no section '## [{version}] - YYYY-MM-DD' with entries: write it and commit it first."
    return None


def check_metadata(archive: Path, version: str) -> None:
    """Refuses an archive with invalid metadata, with another version, or without the README."""
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as wheel:
            [name] = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
            data = wheel.read(name)
    else:
        with tarfile.open(archive) as sdist:
            member = sdist.extractfile(f"{archive.name.removesuffix('.tar.gz')}/PKG-INFO")
            assert member is not None
            data = member.read()
    metadata = Metadata.from_email(data)  # raises an ExceptionGroup that names every invalid field
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    if str(metadata.version) != version or (metadata.description or "").strip() != readme.strip():
        raise ValueError(f"{archive.name} is of version {metadata.version}, or holds another README.")


def write(text: str) -> None:
    """Writes the file that has the version, whole or not at all."""
    temporary = VERSIONED.with_suffix(".tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(VERSIONED)


def release(version: str) -> None:
    before = VERSIONED.read_text(encoding="utf-8")
    write(LINE.sub(f'__version__ = "{version}"', before))
    try:
        subprocess.run([sys.executable, "-m", "build", "--outdir", ROOT / "dist", ROOT], check=True)
        for archive in (f"sb3_sap-{version}-py3-none-any.whl", f"sb3_sap-{version}.tar.gz"):
            check_metadata(ROOT / "dist" / archive, version)
            print(f"{archive}: the metadata are valid")
    except BaseException:
        write(before)
        raise
    if git("status", "--porcelain"):  # the version was set already where it is the first release
        git("commit", "--all", "--message", f"Release {version}")
    git("tag", "--annotate", f"v{version}", "--cleanup=verbatim", "--message", f"{version}\n\n{section_of(version)}\n")
    print(f"Tagged v{version}. Go on with the release checklist in CONTRIBUTING.md.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("version")
    wanted = parser.parse_args().version
    if problem := objection(wanted):
        sys.exit(problem)
    release(wanted)
