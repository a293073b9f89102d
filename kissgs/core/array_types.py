"""Array types for signatures: dtype and shape, as ``Float32[np.ndarray, "N 3"]``.

They are jaxtyping's, which the tests load first and so execute. At run time nobody evaluates annotations, and without
it a decoder needs 13 MB less and starts sooner.
"""

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import Bool, Float, Float32, Float64, Int, Int32, Int64, Shaped, UInt8, UInt16, UInt32
else:

    class _Unchecked:
        """Stands for any of them where nothing is checked."""

        def __class_getitem__(cls, item: object) -> type:
            return cls

    Bool = Float = Float32 = Float64 = Int = Int32 = Int64 = Shaped = UInt8 = UInt16 = UInt32 = _Unchecked

__all__ = ["Bool", "Float", "Float32", "Float64", "Int", "Int32", "Int64", "Shaped", "UInt8", "UInt16", "UInt32"]
