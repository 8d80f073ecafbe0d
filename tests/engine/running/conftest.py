from tests.cli.conftest import pano_mvs

__all__ = ["pano_mvs"]
