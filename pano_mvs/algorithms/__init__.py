"""The algorithms: arrays and scene records in, arrays and scene records out; no settings files and no disk.

Compiled kernels are cached in a folder of the user, see `pano_mvs.core.kernel_cache`.
"""

from pano_mvs.core.kernel_cache import use_kernel_cache

use_kernel_cache()
