"""A page to send: a folder or one file that shows a run in any browser, without a server and without a network."""

from pano_mvs_page.scene_parts import ShareOptions
from pano_mvs_page.share import Shared, share_run

__all__ = ["ShareOptions", "Shared", "share_run"]
