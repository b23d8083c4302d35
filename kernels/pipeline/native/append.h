// Adds the values in some of eight lanes to a list, and returns their number. The list needs room for all eight. There
// is no branch for each lane, as the number of lanes is hard to predict.
auto append = [](auto* list, auto values, unsigned lanes) -> int {
#ifdef __AVX512VL__
    typedef long long Eight __attribute__((vector_size(64), aligned(4)));
    typedef int Half __attribute__((vector_size(32), aligned(4)));
    if constexpr (sizeof(values) == 64)
        *(Eight*)list = __builtin_ia32_compressdi512_mask((Eight)values, (Eight)values, lanes);
    else
        *(Half*)list = __builtin_ia32_compresssi256_mask((Half)values, (Half)values, lanes);
#else
    for (unsigned rest = lanes; rest; rest &= rest - 1)
        *list++ = values[__builtin_ctz(rest)];
#endif
    return __builtin_popcount(lanes);
};
