from tests.cli.conftest import pano_mvs
from tests.engine.conftest import finished, finished_once, toy

__all__ = ["finished", "finished_once", "pano_mvs", "toy"]
