"""Array types for signatures: dtype and shape, as ``Float32[np.ndarray, "N 3"]``. They are jaxtyping's if the tests
have loaded it, which check them at run time. Otherwise annotations are not evaluated, and without jaxtyping a decoder
needs 13 MB less and starts sooner."""

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import (
        Bool,
        Float,
        Float32,
        Float64,
        Int,
        Int32,
        Int64,
        Integer,
        Shaped,
        UInt8,
        UInt16,
        UInt32,
        UInt64,
    )
else:
    Bool = Float = Float32 = Float64 = Int = Int32 = Int64 = Integer = Shaped = tuple  # placeholders: tuple[…] is valid
    UInt8 = UInt16 = UInt32 = UInt64 = tuple

__all__ = ["Bool", "Float", "Float32", "Float64", "Int", "Int32", "Int64", "Integer", "Shaped"]
__all__ += ["UInt8", "UInt16", "UInt32", "UInt64"]
