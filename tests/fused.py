"""Whether machine code fuses multiplications with additions: it rounds once where the processor can, else twice."""

from udkjax.native.code import processor


def is_fused() -> bool:
    cpu, features = processor.target()
    return not processor._is_x86() or cpu in (processor.AVX2.cpu, processor.AVX512.cpu) or "+fma" in features.split(",")
