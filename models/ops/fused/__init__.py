"""The hot loops of non-local means, NFOR, WLR, LBF and SVGF, fused into compiled kernels for the CPU (Numba).

The same formulas as `models.ops.nlm`, `models.ops.regression`, `models.ops.histogram_distance`,
`models.ops.local_regression`, `models.ops.scaled_bilateral` and `models.ops.atrous`, which are the reference
and run where Numba is not installed (optional extra `fast`) or cannot work. Here a tile of pixels stays in
the cache through all steps: distances, box sums, exponential, sums of products, factorisation, prediction.
Strips of rows run on as many threads as PyTorch may use; each adds into images of its own, which are joined
in order.

Weights below 3e-20 are taken as 0; `weights.py` says why.

How the loops are written. The innermost runs over the columns of a tile; its length is not a constant, since
the compiler would unroll it before it could use vector instructions, and indices that start inside an image
are unsigned, since signed ones are tested for being negative, element by element. Arrays are indexed, not
sliced: making a view costs as much as a short row. Compiled code is kept on disk by Numba.
"""

from models.ops.fused.cache import kept_apart

with kept_apart():
    from models.ops.fused.bilateral import filter_scaled as filter_scaled
    from models.ops.fused.edges import Edges as Edges
    from models.ops.fused.edges import edge_means as edge_means
    from models.ops.fused.filtering import FeatureMaps as FeatureMaps
    from models.ops.fused.filtering import filter_images as filter_images
    from models.ops.fused.histograms import pixel_terms as pixel_terms
    from models.ops.fused.local import Numbers as Numbers
    from models.ops.fused.local_rows import Found as Found
    from models.ops.fused.local_rows import Local as Local
    from models.ops.fused.local_rows import estimate as estimate
    from models.ops.fused.local_rows import finish as finish
    from models.ops.fused.regression import regress as regress
    from models.ops.fused.strips import Kernel as Kernel
