"""What the product exists for: arrays and scene records in, arrays and scene records out; no settings file.

Compiled kernels are kept in a folder of the user's, see `pano_mvs.core.kernel_cache`.
"""

from pano_mvs.core.kernel_cache import use_kernel_cache

use_kernel_cache()
