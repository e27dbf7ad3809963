"""Engine `warp`: MuJoCo Warp, with dynamics, a constraint solver and contacts in kernels of our own."""
