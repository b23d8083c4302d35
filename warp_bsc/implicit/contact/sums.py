"""Sums of many terms on GPUs in one order, whether one thread has them all or four share them.

Terms are read in pairs, and where they are before that: most of the time is waiting for memory.
"""

_SUM = """
    float sums[4][SIZE] = {};
    auto add = [&](float* sum, const Term& t) { ADD };
#if defined(__CUDA_ARCH__)
    if (parts == 1) {
        int ahead[4];
#pragma unroll
        for (int k = 0; k < 4; ++k) ahead[k] = first < end ? PLACES[min(first + k, end - 1)] : 0;
        for (int n = first; n < end; n += 4) {
            const int now[4] = {ahead[0], ahead[1], ahead[2], ahead[3]};
#pragma unroll
            for (int k = 0; k < 4; ++k) ahead[k] = PLACES[min(n + 4 + k, end - 1)];
#pragma unroll
            for (int k = 0; k < 4; k += 2) {
                const Term one = read(now[k]), other = read(now[k + 1]);
                if (n + k < end) add(sums[k], one);
                if (n + k + 1 < end) add(sums[k + 1], other);
            }
        }
    } else {
        for (int n = first + part; n < end; n += 4) add(sums[0], read(PLACES[n]));
        const unsigned mask = 15u << (threadIdx.x & 28u);
        for (int c = 0; c < SIZE; ++c) {
            sums[2][c] = __shfl_xor_sync(mask, sums[0][c], 2);
            sums[1][c] = __shfl_xor_sync(mask, sums[0][c] + sums[2][c], 1);
        }
    }
    for (int c = 0; c < SIZE; ++c) sums[0][c] = (sums[0][c] + sums[2][c]) + (sums[1][c] + sums[3][c]);
#else
    for (int n = first; n < end; ++n) add(sums[0], read(PLACES[n]));
#endif
    RESULT result;
    for (int c = 0; c < SIZE; ++c) ((float*)&result)[c] = sums[0][c];
    return result;
"""


def sum_of(result: str, size: int, places: str, term: str, read: str, add: str) -> str:
    """Returns the code of a function that sums up terms from ``first`` to ``end``.

    It has 4 ``parts`` that are threads which follow each other, of which each gets the sum, or 1.

    Args:
        result: Type of the sum.
        size: Number of its components.
        places: Array that says where each term is.
        term: Members of what is read.
        read: Statements that read them at a ``place`` into ``t``.
        add: Statements that add ``t`` to the components ``sum``.
    """
    begin = f"    struct Term {{ {term} }};\n    auto read = [&](int place) {{ Term t; {read} return t; }};\n"
    code = _SUM.replace("SIZE", str(size)).replace("PLACES", places).replace("ADD", add).replace("RESULT", result)
    return begin + code
