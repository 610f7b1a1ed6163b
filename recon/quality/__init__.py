"""Quality of samples: gaps, clipping, clock jumps, dropped samples, sensors of noise and wrong signs are found here.

It works on recordings and motions. It writes no file, and whether a recording is reconstructed again is decided in
``recon.pipeline``.
"""
