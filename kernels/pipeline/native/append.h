// Adds the values in some of eight lanes to a list, and returns their number. The list needs room for all eight. There
// is no branch for each lane, as the number of lanes is hard to predict.
auto append = [](auto* list, auto values, unsigned lanes) -> int {
#ifdef __AVX512VL__
    if constexpr (sizeof(values) == 64) {
        typedef long long Words __attribute__((vector_size(64)));
        const Words words = __builtin_bit_cast(Words, values);
        const Words packed = __builtin_ia32_compressdi512_mask(words, words, lanes);
        __builtin_memcpy(list, &packed, sizeof(packed));
    } else {
        typedef int Words __attribute__((vector_size(32)));
        const Words words = __builtin_bit_cast(Words, values);
        const Words packed = __builtin_ia32_compresssi256_mask(words, words, lanes);
        __builtin_memcpy(list, &packed, sizeof(packed));
    }
#else
    for (unsigned rest = lanes; rest; rest &= rest - 1)
        *list++ = values[__builtin_ctz(rest)];
#endif
    return __builtin_popcount(lanes);
};
