"""Quality of samples: gaps, clipping, clock jumps and dropped samples are found and described here.

It works on recordings and motions. It writes no file, and whether a recording is reconstructed again is decided in
``recon.pipeline``.
"""
