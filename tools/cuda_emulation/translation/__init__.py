"""How PTX becomes C: ``python -m cuda_emulation.translation IN.ptx OUT.so``.

Covers what Dr.Jit emits and the kernels that it brings along; anything else raises :class:`NotImplementedError`.
"""
