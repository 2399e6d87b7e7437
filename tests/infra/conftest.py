import pytest

from tests.infra.manifests import FOLDERS, build


@pytest.fixture(scope="session")
def built():
    """Folder of infra/kubernetes → its documents."""
    return {folder: build(folder) for folder in FOLDERS}
