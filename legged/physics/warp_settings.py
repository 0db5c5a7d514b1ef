"""Settings of Warp. Every package with kernels imports this module first."""

import warp as wp

wp.config.log_level = wp.LOG_WARNING
wp.config.enable_backward = False  # kernels here are not differentiated, and adjoint code doubles the compilation time
wp.init()
