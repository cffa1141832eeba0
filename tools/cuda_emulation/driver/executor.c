/* Threads, warps and blocks of a launch, one after the other on one core.
 *
 * Threads of kernels with collective operations are coroutines. All threads of a warp (or block) run until each of them
 * waits in a collective operation or is done. Then one operation is completed: of those whose members have all arrived
 * the one that comes first in the program, which is how diverged threads meet again soonest.
 *
 * Two variables of the environment choose other orders that are just as legal, and must not change results by more than
 * the order of additions does:
 *   EMULATED_CUDA_MASKS   "split": activemask answers with a random part of the threads that wait in that instruction
 *                         instead of with all of them; "single": with one of them
 *   EMULATED_CUDA_ORDER   "reverse": blocks run from the last to the first (but for kernels with barriers, which may
 *                         wait for earlier blocks)
 */
#define _GNU_SOURCE
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include "executor.h"

#if !defined(__x86_64__) || !defined(__linux__)
#error "The coroutines of the emulated CUDA device are written for Linux on x86-64."
#endif

#define STACK_BYTES ((size_t) 256 << 10)
#define MOST_THREADS 1024
#define MOST_SHARED_BYTES ((size_t) 1 << 20)
#define WARP 32
#define UNINITIALISED 0xCD
#define UNDEFINED 0xDEADBEEFu

typedef struct Fiber {
    Thread thread; /* first, so that a pointer to it is one to the fiber */
    void *sp;
    uint8_t *stack;
    void (*run)(Thread *);
    int waits, done, site;
    enum Collective kind;
    Operands operands;
    uint32_t result;
    uint8_t predicate;
} Fiber;

static Fiber fibers[MOST_THREADS];
static Fiber *current;
static void *scheduler_sp;

/* ---- Coroutines ------------------------------------------------------------------------------------------------ */

void emulated_cuda_switch(void **save, void *load);
__asm__(".text\n.globl emulated_cuda_switch\n.hidden emulated_cuda_switch\nemulated_cuda_switch:\n"
        "push %rbp\npush %rbx\npush %r12\npush %r13\npush %r14\npush %r15\n"
        "mov %rsp, (%rdi)\nmov %rsi, %rsp\n"
        "pop %r15\npop %r14\npop %r13\npop %r12\npop %rbx\npop %rbp\nret\n");

static void fiber_main(void) {
    current->run(&current->thread);
    current->done = 1;
    emulated_cuda_switch(&current->sp, scheduler_sp);
    abort();
}

static uint32_t wait_for_others(Thread *thread, int site, enum Collective kind, Operands operands, uint8_t *predicate) {
    Fiber *fiber = (Fiber *) thread;
    fiber->site = site;
    fiber->kind = kind;
    fiber->operands = operands;
    fiber->waits = 1;
    emulated_cuda_switch(&fiber->sp, scheduler_sp);
    if (predicate) *predicate = fiber->predicate;
    return fiber->result;
}

static void start(Fiber *fiber, void (*run)(Thread *)) {
    if (!fiber->stack) {
        int flags = MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE;
        fiber->stack = mmap(NULL, STACK_BYTES, PROT_READ | PROT_WRITE, flags, -1, 0);
        if (fiber->stack == MAP_FAILED) abort();
    }
    fiber->run = run;
    fiber->waits = fiber->done = 0;
    void **sp = (void **) (fiber->stack + STACK_BYTES - 72); /* aligned as behind a call */
    *sp = NULL;
    *--sp = (void *) fiber_main;
    for (int saved = 0; saved < 6; saved++) *--sp = NULL;
    fiber->sp = sp;
}

/* ---- Collective operations ------------------------------------------------------------------------------------- */

static int is_set(const char *variable, const char *value) {
    const char *found = getenv(variable);
    return found && !strcmp(found, value);
}

static uint32_t random_bits(void) {
    static uint64_t state = 88172645463325252ull; /* xorshift (Marsaglia 2003) */
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return (uint32_t) (state >> 16);
}

static int is_member(const Fiber *fiber, int lane) {
    return fiber->kind == ACTIVE_MASK || (fiber->operands.mask >> lane & 1);
}

static int has_arrived(const Fiber *warp, const Fiber *fiber, int lane) {
    return warp[lane].waits && warp[lane].site == fiber->site;
}

/* The lane whose operation is the first in the program of those whose members have all arrived; -1 if there is none. */
static int first_complete(const Fiber *warp, int count) {
    int best = -1;
    for (int lane = 0; lane < count; lane++) {
        const Fiber *fiber = &warp[lane];
        if (!fiber->waits || fiber->kind == BAR_BLOCK || (best >= 0 && fiber->site >= warp[best].site)) continue;
        int complete = 1;
        for (int other = 0; other < count && fiber->kind != ACTIVE_MASK; other++)
            if (is_member(fiber, other) && !warp[other].done && !has_arrived(warp, fiber, other)) complete = 0;
        if (complete) best = lane;
    }
    return best;
}

static uint32_t lanes_together(const Fiber *warp, int count, int lane) {
    const Fiber *fiber = &warp[lane];
    uint32_t group = 0;
    for (int other = 0; other < count; other++)
        if (has_arrived(warp, fiber, other) && is_member(fiber, other)) group |= 1u << other;
    if (fiber->kind != ACTIVE_MASK) return group;
    if (is_set("EMULATED_CUDA_MASKS", "single")) return 1u << lane;
    return is_set("EMULATED_CUDA_MASKS", "split") ? group & (random_bits() | 1u << lane) : group;
}

static uint32_t match(const Fiber *warp, uint32_t group, int lane) {
    uint32_t peers = 0;
    for (int other = 0; other < WARP; other++)
        if ((group >> other & 1) && warp[other].operands.a == warp[lane].operands.a) peers |= 1u << other;
    return peers;
}

/* PTX ISA, shfl.sync: `b` is a lane or a distance, `c` holds a clamp and a mask of segments. */
static uint32_t shuffle(Fiber *warp, uint32_t group, int lane) {
    Fiber *fiber = &warp[lane];
    int b = fiber->operands.b & 31, clamp = fiber->operands.c & 31, segment = fiber->operands.c >> 8 & 31;
    int last = (lane & segment) | (clamp & ~segment), source, valid;
    switch (fiber->kind) {
        case SHFL_UP: source = lane - b; valid = source >= last; break;
        case SHFL_DOWN: source = lane + b; valid = source <= last; break;
        case SHFL_BFLY: source = lane ^ b; valid = source <= last; break;
        default: source = (lane & segment) | (b & ~segment); valid = source <= last;
    }
    fiber->predicate = (uint8_t) valid;
    if (!valid) source = lane;
    return group >> source & 1 ? warp[source].operands.a : UNDEFINED;
}

static void answer(Fiber *warp, uint32_t group, int lane, uint32_t ballot) {
    Fiber *fiber = &warp[lane];
    switch (fiber->kind) {
        case ACTIVE_MASK: fiber->result = group; break;
        case MATCH_ANY: fiber->result = match(warp, group, lane); break;
        case VOTE_ALL: fiber->result = ballot == group; break;
        case VOTE_ANY: fiber->result = ballot != 0; break;
        case VOTE_UNI: fiber->result = ballot == group || ballot == 0; break;
        case VOTE_BALLOT: fiber->result = ballot; break;
        case BAR_WARP: fiber->result = 0; break;
        default: fiber->result = shuffle(warp, group, lane);
    }
}

/* Complete one operation of a warp; returns 0 if none can be. */
static int complete_one(Fiber *warp, int count) {
    int first = first_complete(warp, count);
    if (first < 0) return 0;
    uint32_t group = lanes_together(warp, count, first), ballot = 0;
    for (int lane = 0; lane < count; lane++)
        if ((group >> lane & 1) && warp[lane].operands.a) ballot |= 1u << lane;
    for (int lane = 0; lane < count; lane++)
        if (group >> lane & 1) answer(warp, group, lane, ballot);
    for (int lane = 0; lane < count; lane++)
        if (group >> lane & 1) warp[lane].waits = 0;
    return 1;
}

/* ---- Scheduling ------------------------------------------------------------------------------------------------ */

/* Run all threads that do not wait; returns whether any is left. */
static int run_ready(int count) {
    int left = 0;
    for (int i = 0; i < count; i++) {
        if (fibers[i].done) continue;
        left = 1;
        if (fibers[i].waits) continue;
        current = &fibers[i];
        emulated_cuda_switch(&scheduler_sp, fibers[i].sp);
    }
    return left;
}

static void pass_barrier(int count) {
    for (int i = 0; i < count; i++) {
        if (fibers[i].done || (fibers[i].waits && fibers[i].kind == BAR_BLOCK)) continue;
        fprintf(stderr, "Emulated CUDA device: the threads of a block wait for each other for ever.\n");
        abort();
    }
    for (int i = 0; i < count; i++) fibers[i].waits = 0;
}

static void run_fibers(const Entry *entry, int count) {
    for (int i = 0; i < count; i++) start(&fibers[i], entry->run);
    while (run_ready(count)) {
        int is_done = 1, completed = 0;
        for (int i = 0; i < count; i++) is_done &= fibers[i].done;
        if (is_done) return;
        for (int first = 0; first < count; first += WARP)
            completed |= complete_one(&fibers[first], count - first < WARP ? count - first : WARP);
        if (!completed) pass_barrier(count);
    }
}

static void place(Thread *thread, const Launch *launch, const uint32_t block_at[3], uint32_t index, uint8_t *shared) {
    const uint32_t *block = launch->block;
    memcpy(thread->ntid, block, sizeof thread->ntid);
    memcpy(thread->nctaid, launch->grid, sizeof thread->nctaid);
    memcpy(thread->ctaid, block_at, sizeof thread->ctaid);
    thread->tid[0] = index % block[0];
    thread->tid[1] = index / block[0] % block[1];
    thread->tid[2] = index / block[0] / block[1];
    thread->lane = index % WARP;
    thread->shared = shared;
    thread->params = launch->params;
    thread->collective = wait_for_others;
}

static void run_block(const Launch *launch, const uint32_t at[3], uint8_t *shared) {
    const Entry *entry = launch->entry;
    uint32_t threads = launch->block[0] * launch->block[1] * launch->block[2];
    uint32_t width = entry->cooperation == IN_BLOCKS ? threads : entry->cooperation == IN_WARPS ? WARP : 1;
    memset(shared, UNINITIALISED, entry->shared_bytes + launch->dynamic_shared_bytes);
    for (uint32_t first = 0; first < threads; first += width) {
        uint32_t count = threads - first < width ? threads - first : width;
        for (uint32_t i = 0; i < count; i++) place(&fibers[i].thread, launch, at, first + i, shared);
        if (entry->cooperation == ALONE) entry->run(&fibers[0].thread);
        else run_fibers(entry, (int) count);
    }
}

void execute(const Launch *launch) {
    static uint8_t *shared;
    if (!shared) shared = aligned_alloc(256, MOST_SHARED_BYTES);
    const uint32_t *grid = launch->grid, *block = launch->block;
    size_t shared_bytes = (size_t) launch->entry->shared_bytes + launch->dynamic_shared_bytes;
    if (!shared || (uint64_t) block[0] * block[1] * block[2] > MOST_THREADS || shared_bytes > MOST_SHARED_BYTES) {
        fprintf(stderr, "Emulated CUDA device: a launch is larger than the device.\n");
        abort();
    }
    int is_reversed = is_set("EMULATED_CUDA_ORDER", "reverse") && launch->entry->cooperation != IN_BLOCKS;
    uint64_t blocks = (uint64_t) grid[0] * grid[1] * grid[2];
    for (uint64_t n = 0; n < blocks; n++) {
        uint64_t id = is_reversed ? blocks - 1 - n : n;
        uint64_t row = id / grid[0];
        uint32_t at[3] = {(uint32_t) (id % grid[0]), (uint32_t) (row % grid[1]), (uint32_t) (row / grid[1])};
        run_block(launch, at, shared);
    }
}
