"""The project's CUDA kernels on a machine without a GPU: an emulated device for Dr.Jit and for PyTorch.

Dr.Jit starts its CUDA back end on a driver library of ours (``driver/``) and makes the PTX that it would make for a
GPU; ``translation/`` turns that to C, which runs thread by thread. PyTorch's tensors say that they are on ``cuda:0``
and live in host memory (``torch_device.py``). ``make test-cuda-emulated`` runs the tests marked ``gpu`` on it.

It cannot show races, what only happens because work is asynchronous, the rounding of a GPU's approximate instructions,
how long anything takes, or what the assembler of the driver makes of the PTX.
"""
