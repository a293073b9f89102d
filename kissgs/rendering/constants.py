"""The image model: how Gaussians are rendered, with the constants of gsplat and the original 3DGS.

A camera (W, t; fx, fy, cx, cy; dilation) renders a Gaussian with mean m, rotation R, standard deviations s and opacity
o thus:

1. m' = W m + t; it is left out if its depth z' is outside [:data:`NEAR`, :data:`FAR`].
2. Its footprint has the centre (fx x'/z' + cx, fy y'/z' + cy) and the covariance J W R diag(s²) (J W R)ᵀ +
   dilation · 1, with J the derivative of that projection at m'. For J alone, x'/z' and y'/z' are clamped to the
   image widened by :data:`FRUSTUM_MARGIN` of half its size on either side (EWA splatting, Zwicker et al. 2001).
   In a scene trained with antialiasing (:attr:`kissgs.Splats.antialiased`), o is multiplied by the root of the
   covariance's determinant before the dilation divided by that after it, which keeps the Gaussian's sum over the image
   (Mip-Splatting, Yu et al. 2024; gsplat's mode "antialiased").
3. At a pixel centre p, its alpha is o exp(-½ (p - centre)ᵀ covariance⁻¹ (p - centre)), at most :data:`ALPHA_MAX`, and
   0 if that is below :data:`ALPHA_MIN`. The bounding boxes and tiles of renderers leave out only pixels where alpha is
   0, so the image does not depend on them.
4. Its colour is max(0, ½ + SH(direction from the camera's centre to m)).
5. Front to back by depth z' as a float32 (equal depths in the scene's order): colour += T alpha colour, T *= 1 - alpha.
   The first Gaussian that would take T to :data:`TRANSMITTANCE_MIN` or below is not drawn, nor is any behind it. The
   background is added with the remaining T.

gsplat up to 1.5.3 has 0.999 for :data:`ALPHA_MAX`; later versions, like the original 3DGS, 0.99. They also have a least
factor of 0.005 for antialiased scenes, with which an opaque Gaussian of no size has an alpha of 1.3 / 255.
"""

NEAR = 0.01  # depth of the near plane, world units
FAR = 1e10  # depth of the far plane, world units
DILATION = 0.3  # usual variance added to both axes of a footprint, pixels², so that none is much narrower than a pixel
FRUSTUM_MARGIN = 0.3  # in units of half the image; within it the projection's derivative is not clamped
ALPHA_MIN = 1 / 255  # smallest alpha that is drawn
ALPHA_MAX = 0.99  # largest alpha; larger ones are clamped
TRANSMITTANCE_MIN = 1e-4  # transmittance at which a pixel is complete: (1 - ALPHA_MAX)², two opaque Gaussians
TILE = 16  # side of the squares of pixels that are rendered together, pixels; the image does not depend on it
