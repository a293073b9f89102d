"""What a picture of Gaussians is: the constants of gsplat's classic mode, which are those of the original 3DGS.

A Gaussian with mean m, rotation R, standard deviations s and opacity o is drawn by a camera (W, t; fx, fy, cx, cy) so:

1. m' = W m + t; it is left out if its depth z' is outside [:data:`NEAR`, :data:`FAR`].
2. Its footprint has the centre (fx x'/z' + cx, fy y'/z' + cy) and the covariance J W R diag(s²) (J W R)ᵀ +
   :data:`DILATION` · 1, with J the derivative of that projection at m'. For J alone, x'/z' and y'/z' are clamped to the
   picture widened by :data:`FRUSTUM_MARGIN` of half its size on either side (EWA splatting, Zwicker et al. 2001).
3. At a pixel centre p, its alpha is o exp(-½ (p - centre)ᵀ covariance⁻¹ (p - centre)), at most :data:`ALPHA_MAX`, and
   none where that is below :data:`ALPHA_MIN`. The box and tiles that renderers put around a footprint leave out only
   pixels where this holds, so they are no part of the picture.
4. Its colour is max(0, ½ + SH(direction from the camera's centre to m)).
5. Front to back by depth z' as a float32 (equal depths in the scene's order): colour += T alpha colour, T *= 1 - alpha.
   The first one that would take T to :data:`TRANSMITTANCE_MIN` or below is not drawn, nor is anything behind it. What
   is left of T shows the background.

gsplat up to 1.5.3 has 0.999 for :data:`ALPHA_MAX`; later versions, like the original 3DGS, 0.99.
"""

NEAR = 0.01
FAR = 1e10
DILATION = 0.3
"""Pixels²: no footprint is narrower than a pixel or so."""
FRUSTUM_MARGIN = 0.3
ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
"""(1 - ALPHA_MAX)²: two opaque Gaussians end a pixel."""

TILE = 16
"""Side of the squares of pixels that are drawn at a time. Not part of what the picture is."""
