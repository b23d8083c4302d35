"""Queues between the phases of a pipeline: an array of entries, and a count on the device that any thread may raise.

Counts go on where a queue is full, so that they tell how many entries did not fit: nothing is dropped silently.
"""

import warp as wp


def _raising(count: str, number: str, threads: str = "__activemask()") -> str:
    """Returns the native code that raises a count by one, of a type of ``number``, and returns its old value.

    On a GPU one atomic does so for all threads of a warp that are here, or those of them in the mask ``threads``.
    """
    return f"""
#if defined(__CUDA_ARCH__)
    const unsigned mask = {threads};
    const int lane = threadIdx.x & 31;
    const int leader = __ffs(mask) - 1;
    {number} base = 0;
    if (lane == leader)
        base = atomicAdd(({number}*)&{count}, ({number})__popc(mask));
    base = __shfl_sync(mask, base, leader);
    return base + __popc(mask & ((1u << lane) - 1u));
#else
    return __atomic_fetch_add(&{count}, 1, __ATOMIC_RELAXED);
#endif
"""


@wp.func_native(snippet=_raising("counts.data[queue]", "unsigned long long"))
def take_slot(counts: wp.array[wp.int64], queue: int) -> wp.int64:
    """Raises the count of a queue by one, and returns its old value: the index of the new entry."""
    ...


@wp.func_native(snippet=_raising("count.data[0]", "int"))
def take_slot_int(count: wp.array[int]) -> int:
    """Raises a count of 32 bits, which a conditional of a CUDA graph can read, by one, and returns its old value."""
    ...


@wp.func_native(snippet=_raising("counts.data[queue]", "int", "__match_any_sync(__activemask(), queue)"))
def take_slot_of(counts: wp.array[int], queue: int) -> int:
    """Raises one of several counts of 32 bits by one, and returns its old value."""
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    // one atomic for all threads of a warp that are here; the sum over lower lanes, bit by bit
    const unsigned mask = __activemask();
    const int lane = threadIdx.x & 31;
    const unsigned lower = (1u << lane) - 1u;
    int before = 0;
    int total = 0;
    for (int bit = 0; bit < 6; ++bit) {
        const unsigned with_bit = __ballot_sync(mask, (amount >> bit) & 1);
        before += __popc(with_bit & lower) << bit;
        total += __popc(with_bit) << bit;
    }
    const int leader = __ffs(mask) - 1;
    unsigned long long base = 0;
    if (lane == leader && total > 0)
        base = atomicAdd((unsigned long long*)&counts.data[queue], (unsigned long long)total);
    base = __shfl_sync(mask, base, leader);
    return (wp::int64)base + before;
#else
    return amount == 0 ? 0 : __atomic_fetch_add(&counts.data[queue], (wp::int64)amount, __ATOMIC_RELAXED);
#endif
"""
)
def take_slots(counts: wp.array[wp.int64], queue: int, amount: int) -> wp.int64:
    """Raises the count of a queue by an amount, and returns its old value: the index of the first entry.

    On a GPU the amount must be below 64.
    """
    ...


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    // one atomic for all threads of a warp that are here; its result is not used
    const unsigned mask = __activemask();
    int total = 0;
    for (int bit = 0; bit < 6; ++bit)
        total += __popc(__ballot_sync(mask, (amount >> bit) & 1)) << bit;
    if ((threadIdx.x & 31) == __ffs(mask) - 1 && total > 0)
        atomicAdd((unsigned long long*)&counts.data[queue], (unsigned long long)total);
#else
    if (amount != 0)
        __atomic_fetch_add(&counts.data[queue], (wp::int64)amount, __ATOMIC_RELAXED);
#endif
"""
)
def raise_count(counts: wp.array[wp.int64], queue: int, amount: int):
    """Raises the count of a queue by an amount, below 64 on a GPU."""
    ...


@wp.func
def write(pair: wp.vec2i, queue: wp.array[wp.vec2i], slot: wp.int64):
    """Writes a pair to a slot of a queue, if its capacity allows."""
    if slot < wp.int64(queue.shape[0]):
        queue[wp.int32(slot)] = pair


@wp.func
def append(pair: wp.vec2i, queue: wp.array[wp.vec2i], counts: wp.array[wp.int64], count: int):
    """Writes a pair to the end of a queue, if its capacity allows."""
    write(pair, queue, take_slot(counts, count))


@wp.func
def is_filled(i: int, queue: wp.array[wp.vec2i], counts: wp.array[wp.int64], count: int) -> bool:
    """Returns whether entry i of a queue has been written."""
    return i < queue.shape[0] and wp.int64(i) < counts[count]


@wp.func
def filled_entries(queue: wp.array[wp.vec2i], counts: wp.array[wp.int64], count: int) -> int:
    """Returns the number of entries of a queue; those that did not fit are counted, but are not there."""
    return int(wp.min(counts[count], wp.int64(queue.shape[0])))


@wp.func
def has_overflowed(counts: wp.array[wp.int64], capacities: wp.array[wp.int64]) -> bool:
    """Returns whether one of the queues of a detection was too small for it."""
    too_small = int(0)
    for i in range(1, counts.shape[0]):  # the first counts positions that are not finite
        too_small += wp.where(counts[i] > capacities[i], 1, 0)  # without a branch, a GPU waits for all of them at once
    return too_small > 0
