"""Reads and writes of 16 bytes at a time on GPUs, where Warp has those of 4: phases mostly wait for memory."""

import warp as wp

wp.set_module_options({"enable_backward": False})

mat34 = wp.types.matrix(shape=(3, 4), dtype=wp.float32)
"""Rows of a 3 x 3 block, each with a fourth number without meaning."""


def _reading(scalar: str) -> str:
    """Returns the native code that reads four numbers of a type."""
    return f"""
#if defined(__CUDA_ARCH__)
    const {scalar}4 v = *(const {scalar}4*)(values.data + i);
    return wp::vec_t<4, {scalar}>(v.x, v.y, v.z, v.w);
#else
    return values.data[i];
#endif
"""


@wp.func_native(snippet=_reading("int"))
def integers_at(values: wp.array[wp.vec4i], i: int) -> wp.vec4i:
    """Returns four integers, such as the corners of a pair."""
    ...


@wp.func_native(snippet=_reading("float"))
def numbers_at(values: wp.array[wp.vec4], i: int) -> wp.vec4:
    """Returns four numbers, such as the weights of corners."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    *(float4*)(values.data + i) = make_float4(v[0], v[1], v[2], 0.0f);
#else
    values.data[i] = wp::vec4(v[0], v[1], v[2], 0.0f);
#endif
"""
)
def store_numbers(values: wp.array[wp.vec4], i: int, v: wp.vec3):
    """Writes three numbers, and a fourth one without meaning."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    for (int row = 0; row < 3; ++row)
        ((float4*)(blocks.data + k))[row] = make_float4(
            (float)block.data[row][0], (float)block.data[row][1], (float)block.data[row][2], 0.0f);
#else
    for (int c = 0; c < 9; ++c)
        blocks.data[k].data[c / 3][c % 3] = (float)block.data[c / 3][c % 3];
#endif
"""
)
def store_block(blocks: wp.array[mat34], k: int, block: wp.mat33d):
    """Writes a block in single precision."""
    ...


READ_BLOCK = """
    auto read_block = [](const wp::mat_t<3, 4, float>* blocks, int k) {
        wp::mat_t<3, 3, float> block;
#if defined(__CUDA_ARCH__)
        for (int row = 0; row < 3; ++row) {
            const float4 of_row = ((const float4*)(blocks + k))[row];
            block.data[row][0] = of_row.x, block.data[row][1] = of_row.y, block.data[row][2] = of_row.z;
        }
#else
        for (int c = 0; c < 9; ++c)
            block.data[c / 3][c % 3] = blocks[k].data[c / 3][c % 3];
#endif
        return block;
    };
"""
"""Code of a function of native code that reads a block."""


@wp.func_native(snippet=READ_BLOCK + "    return read_block(blocks.data, k);\n")
def stored_block(blocks: wp.array[mat34], k: int) -> wp.mat33:
    """Returns a block that was written."""
    ...
