import os
import shutil

import pytest

from sb3_sap.envs.torcs import installation
from sb3_sap.envs.torcs.installation import Installation, TorcsNotFoundError, find_installation


@pytest.fixture(scope="module")
def torcs():
    """The installation. Without one, tests are skipped; with SB3_SAP_REQUIRE_TORCS set, as in CI, they fail."""
    try:
        return find_installation()
    except TorcsNotFoundError as error:
        if os.environ.get("SB3_SAP_REQUIRE_TORCS"):
            raise
        pytest.skip(str(error))


@pytest.fixture
def copy_of_torcs(torcs, tmp_path):
    """A copy that may be damaged."""
    root = tmp_path / "torcs"
    for path in installation.checksums():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(torcs.root / path, root / path)
    return Installation(root)
