/* What translated kernels, the executor and the driver agree on. */
#pragma once
#include <stddef.h>
#include <stdint.h>

/* Operations for which threads of a warp, or of a block, wait for each other. */
enum Collective {
    ACTIVE_MASK, MATCH_ANY, VOTE_ALL, VOTE_ANY, VOTE_UNI, VOTE_BALLOT, SHFL_UP, SHFL_DOWN, SHFL_BFLY, SHFL_IDX,
    BAR_WARP, BAR_BLOCK
};

typedef struct Operands { uint32_t mask, a, b, c; } Operands;

typedef struct Thread Thread;
struct Thread {
    uint32_t tid[3], ntid[3], ctaid[3], nctaid[3];
    uint32_t lane;
    uint8_t *shared;
    const uint8_t *params;
    /* A collective operation at a site of the program: returns its result, and its predicate if that is asked for. */
    uint32_t (*collective)(Thread *, int site, enum Collective, Operands, uint8_t *predicate);
};

/* How far the threads of a kernel have to do with each other. */
enum Cooperation { ALONE, IN_WARPS, IN_BLOCKS };

/* A kernel, as its translation describes it. */
typedef struct Entry {
    void (*run)(Thread *);
    uint32_t param_count;
    const uint32_t *param_offset, *param_size;
    uint32_t param_bytes, shared_bytes;
    enum Cooperation cooperation;
} Entry;

typedef struct Launch {
    const Entry *entry;
    const uint8_t *params;
    uint32_t grid[3], block[3];
    uint32_t dynamic_shared_bytes;
} Launch;

void execute(const Launch *launch);
