import pytest

from tests.stack.servers import Stack


@pytest.fixture(scope="session")
def stack(tmp_path_factory):
    """The servers of the compose file, running."""
    with Stack(tmp_path_factory.mktemp("stack")) as running:
        yield running
