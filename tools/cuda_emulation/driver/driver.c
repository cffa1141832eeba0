/* An emulated CUDA device: what Dr.Jit needs of the CUDA driver API, as libcuda.so.1 has it, without a GPU.
 *
 * Device memory is host memory. Kernels arrive as PTX, are translated to C, compiled, and executed when they are
 * launched: see executor.c. Nothing is asynchronous; streams and events are there in name only.
 *
 * Environment, set by cuda_emulation.build:
 *   EMULATED_CUDA_TRANSLATE     command that makes a shared library (second argument) of a PTX file (first argument)
 *   EMULATED_CUDA_KERNELS       folder of these libraries, which later processes use again
 * and, if wanted:
 *   EMULATED_CUDA_DUMP          folder that gets the PTX of every module
 *   EMULATED_CUDA_CAPABILITY    compute capability times ten (90)
 *   EMULATED_CUDA_VERSION       CUDA version of the driver (13000)
 *   EMULATED_CUDA_MEMORY        bytes of device memory (2^34)
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>
#include "executor.h"

#define EXPORT __attribute__((visibility("default")))
#define UNUSED __attribute__((unused))

/* CUresult, cuda.h */
enum { SUCCESS = 0, OUT_OF_MEMORY = 2, NOT_FOUND = 500, NOT_SUPPORTED = 801 };

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

static const char *setting(const char *name, const char *otherwise) {
    const char *value = getenv(name);
    return value && *value ? value : otherwise;
}

static long long number(const char *name, long long otherwise) {
    const char *value = setting(name, NULL);
    return value ? atoll(value) : otherwise;
}

static void give_up(const char *what, const char *of) {
    fprintf(stderr, "Emulated CUDA device: %s %s.\n", what, of);
    abort();
}

#include "told.h"

/* ---- Counts of what a host pays for ---------------------------------------------------------------------------- */

enum {
    LAUNCHES, ALLOCATIONS, STREAM_WAITS, CONTEXT_WAITS, EVENT_WAITS, COPY_WAITS, COPIES, FILLS,
    NUMBERS_UP, ARRAYS_UP, BYTES_UP, NUMBERS_DOWN, ARRAYS_DOWN, BYTES_DOWN, COUNTS
};
static const char *const count_names[COUNTS] = {
    "kernel launches", "allocations", "waits for a stream", "waits for the context", "waits for an event",
    "waits for a copy", "asynchronous copies", "fills",
    "numbers to the device", "arrays to the device", "bytes to the device",
    "numbers to the host", "arrays to the host", "bytes to the host",
};
static unsigned long counts[COUNTS];

/* Name and value of a count; NULL behind the last. */
EXPORT const char *emulated_cuda_count(int index, unsigned long *value) {
    if (index < 0 || index >= COUNTS) return NULL;
    *value = counts[index];
    return count_names[index];
}

/* ---- Start, devices, contexts ---------------------------------------------------------------------------------- */

static void *const context = (void *) 0x1000, *const the_stream = (void *) 0x2000, *const the_event = (void *) 0x3000;

EXPORT int cuInit(UNUSED unsigned flags) { return SUCCESS; }
EXPORT int cuDriverGetVersion(int *version) {
    *version = (int) number("EMULATED_CUDA_VERSION", 13000);
    return SUCCESS;
}
EXPORT int cuDeviceGetCount(int *count) {
    *count = 1;
    return SUCCESS;
}
EXPORT int cuDeviceGet(int *device, int ordinal) {
    *device = ordinal;
    return SUCCESS;
}
EXPORT int cuDeviceGetName(char *name, int size, UNUSED int device) {
    snprintf(name, (size_t) size, "emulated device");
    return SUCCESS;
}
EXPORT int cuDeviceGetAttribute(int *value, int attribute, UNUSED int device) {
    int capability = (int) number("EMULATED_CUDA_CAPABILITY", 90);
    switch (attribute) { /* CUdevice_attribute, cuda.h */
        case 16: *value = 132; break; /* multiprocessors */
        case 41: *value = 1; break; /* unified addresses */
        case 75: *value = capability / 10; break;
        case 76: *value = capability % 10; break;
        case 97: *value = 227 * 1024; break; /* shared memory a block */
        case 115: *value = 1; break; /* memory pools */
        default: *value = 0;
    }
    return SUCCESS;
}
EXPORT int cuDevicePrimaryCtxRetain(void **found, UNUSED int device) {
    *found = context;
    return SUCCESS;
}
EXPORT int cuDevicePrimaryCtxRelease_v2(UNUSED int device) { return SUCCESS; }
EXPORT int cuCtxPushCurrent_v2(UNUSED void *pushed) { return SUCCESS; }
EXPORT int cuCtxPopCurrent_v2(void **popped) {
    if (popped) *popped = context;
    return SUCCESS;
}
EXPORT int cuCtxSynchronize(void) {
    counts[CONTEXT_WAITS]++;
    return SUCCESS;
}
EXPORT int cuCtxEnablePeerAccess(UNUSED void *peer, UNUSED unsigned flags) { return SUCCESS; }
EXPORT int cuDeviceCanAccessPeer(int *can, UNUSED int device, UNUSED int peer) {
    *can = 0;
    return SUCCESS;
}
EXPORT int cuGetErrorName(int error, const char **name) {
    *name = error == OUT_OF_MEMORY ? "CUDA_ERROR_OUT_OF_MEMORY" : "CUDA_ERROR";
    return SUCCESS;
}
EXPORT int cuGetErrorString(int error, const char **text) { return cuGetErrorName(error, text); }

/* ---- Streams and events ---------------------------------------------------------------------------------------- */

EXPORT int cuStreamCreate(void **stream, UNUSED unsigned flags) {
    *stream = the_stream;
    return SUCCESS;
}
EXPORT int cuStreamDestroy_v2(UNUSED void *stream) { return SUCCESS; }
EXPORT int cuStreamSynchronize(UNUSED void *stream) {
    counts[STREAM_WAITS]++;
    return SUCCESS;
}
EXPORT int cuStreamWaitEvent(UNUSED void *stream, UNUSED void *event, UNUSED unsigned flags) { return SUCCESS; }
EXPORT int cuStreamWaitEvent_ptsz(UNUSED void *stream, UNUSED void *event, UNUSED unsigned flags) { return SUCCESS; }
EXPORT int cuEventCreate(void **event, UNUSED unsigned flags) {
    *event = the_event;
    return SUCCESS;
}
EXPORT int cuEventDestroy_v2(UNUSED void *event) { return SUCCESS; }
EXPORT int cuEventRecord(UNUSED void *event, UNUSED void *stream) { return SUCCESS; }
EXPORT int cuEventQuery(UNUSED void *event) { return SUCCESS; }
EXPORT int cuEventSynchronize(UNUSED void *event) {
    counts[EVENT_WAITS]++;
    return SUCCESS;
}
EXPORT int cuEventElapsedTime(float *milliseconds, UNUSED void *first, UNUSED void *last) {
    *milliseconds = 0.0f;
    return SUCCESS;
}
EXPORT int cuLaunchHostFunc(UNUSED void *stream, void (*function)(void *), void *argument) {
    function(argument);
    return SUCCESS;
}

/* ---- Memory ---------------------------------------------------------------------------------------------------- */

enum { ALIGNMENT = 256, UNINITIALISED = 0xCD, MOST_BYTES_OF_NUMBERS = 512 };
static size_t used_bytes;

/* What stands before an allocation, of the device's memory or of the host's that the device reads. */
typedef struct Block {
    struct Block *next, *previous;
    size_t bytes;
    int is_host;
} Block;
static Block blocks = {&blocks, &blocks, 0, 0};

static size_t total_bytes(void) { return (size_t) number("EMULATED_CUDA_MEMORY", 1ll << 34); }

/* What is read before it is written is no plausible number. */
static int allocate(void **pointer, size_t bytes, int is_host) {
    int result = OUT_OF_MEMORY;
    bytes = (bytes / ALIGNMENT + 1) * ALIGNMENT;
    pthread_mutex_lock(&lock);
    counts[ALLOCATIONS]++;
    Block *block = used_bytes + bytes <= total_bytes() ? aligned_alloc(ALIGNMENT, bytes + ALIGNMENT) : NULL;
    if (block) {
        *block = (Block) {blocks.next, &blocks, bytes, is_host};
        block->next->previous = blocks.next = block;
        used_bytes += bytes;
        *pointer = memset((char *) block + ALIGNMENT, UNINITIALISED, bytes);
        result = SUCCESS;
    }
    pthread_mutex_unlock(&lock);
    return result;
}

static int release(void *pointer) {
    if (!pointer) return SUCCESS;
    Block *block = (Block *) ((char *) pointer - ALIGNMENT);
    pthread_mutex_lock(&lock);
    used_bytes -= block->bytes;
    block->next->previous = block->previous;
    block->previous->next = block->next;
    pthread_mutex_unlock(&lock);
    free(block);
    return SUCCESS;
}

/* Whether memory is the host's: what it has not been given by us is, too, where the host waits for a copy of it. Else
 * it is a tensor of PyTorch's, which says that it is on the device. */
static int is_of_host(const void *pointer, int waits) {
    for (Block *block = blocks.next; block != &blocks; block = block->next) {
        const char *begin = (char *) block + ALIGNMENT;
        if ((const char *) pointer >= begin && (const char *) pointer < begin + block->bytes) return block->is_host;
    }
    return waits;
}

static int count_copy(const void *target, const void *source, size_t bytes, int waits) {
    pthread_mutex_lock(&lock);
    counts[waits ? COPY_WAITS : COPIES]++;
    int from_host = is_of_host(source, waits), to_host = is_of_host(target, waits);
    if (from_host != to_host) {
        counts[(from_host ? NUMBERS_UP : NUMBERS_DOWN) + (bytes > MOST_BYTES_OF_NUMBERS)]++;
        counts[from_host ? BYTES_UP : BYTES_DOWN] += bytes;
    }
    pthread_mutex_unlock(&lock);
    return to_host && !from_host;
}

static void copy(void *target, const void *source, size_t bytes, int waits) {
    if (count_copy(target, source, bytes, waits)) tell(target, source, bytes);
    else memmove(target, source, bytes);
}

EXPORT int cuDeviceTotalMem_v2(size_t *bytes, UNUSED int device) {
    *bytes = total_bytes();
    return SUCCESS;
}
EXPORT int cuMemGetInfo_v2(size_t *unused, size_t *total) {
    *total = total_bytes();
    *unused = *total - used_bytes;
    return SUCCESS;
}
EXPORT int cuMemAlloc_v2(void **pointer, size_t bytes) { return allocate(pointer, bytes, 0); }
EXPORT int cuMemAllocHost_v2(void **pointer, size_t bytes) { return allocate(pointer, bytes, 1); }
EXPORT int cuMemAllocAsync(void **pointer, size_t bytes, UNUSED void *stream) { return allocate(pointer, bytes, 0); }
EXPORT int cuMemFree_v2(void *pointer) { return release(pointer); }
EXPORT int cuMemFreeHost(void *pointer) { return release(pointer); }
EXPORT int cuMemFreeAsync(void *pointer, UNUSED void *stream) { return release(pointer); }
EXPORT int cuMemAdvise(UNUSED void *pointer, UNUSED size_t bytes, UNUSED int advice, UNUSED int device) {
    return SUCCESS;
}
EXPORT int cuMemcpy(void *target, const void *source, size_t bytes) {
    copy(target, source, bytes, 1);
    return SUCCESS;
}
EXPORT int cuMemcpyAsync(void *target, const void *source, size_t bytes, UNUSED void *stream) {
    copy(target, source, bytes, 0);
    return SUCCESS;
}
#define FILL(name, type)                                                                     \
    EXPORT int name(type *target, type value, size_t count, UNUSED void *stream) {          \
        counts[FILLS]++;                                                                     \
        for (size_t i = 0; i < count && state != IDLE; i++) target[i] = value;               \
        return SUCCESS;                                                                      \
    }
FILL(cuMemsetD8Async, uint8_t) FILL(cuMemsetD16Async, uint16_t) FILL(cuMemsetD32Async, uint32_t)
EXPORT int cuPointerGetAttribute(void *data, int attribute, UNUSED void *pointer) {
    if (attribute == 2) *(unsigned *) data = 2; /* the memory is the device's */
    return SUCCESS;
}

/* ---- Modules and kernels --------------------------------------------------------------------------------------- */

typedef struct Module { void *library; } Module;
typedef struct Function { const Entry *entry; } Function;

static uint64_t hash_of(const char *text) { /* FNV-1a */
    uint64_t hash = 14695981039346656037ull;
    for (; *text; text++) hash = (hash ^ (unsigned char) *text) * 1099511628211ull;
    return hash;
}

static void write_text(const char *path, const char *text) {
    FILE *file = fopen(path, "w");
    if (!file || fputs(text, file) < 0 || fclose(file)) give_up("cannot write", path);
}

static void *translated(const char *text, uint64_t hash) {
    char *library_path, *ptx_path, *command;
    const char *folder = setting("EMULATED_CUDA_KERNELS", NULL), *translate = setting("EMULATED_CUDA_TRANSLATE", NULL);
    if (!folder || !translate) give_up("start it by", "cuda_emulation.build.environment()");
    if (asprintf(&library_path, "%s/%016lx.so", folder, hash) < 0) abort();
    if (access(library_path, R_OK)) {
        if (asprintf(&ptx_path, "%s/%016lx.%d.ptx", folder, hash, getpid()) < 0) abort();
        if (asprintf(&command, "%s '%s' '%s'", translate, ptx_path, library_path) < 0) abort();
        write_text(ptx_path, text);
        if (system(command)) give_up("cannot translate", ptx_path);
        unlink(ptx_path);
        free(command);
        free(ptx_path);
    }
    void *library = dlopen(library_path, RTLD_NOW | RTLD_LOCAL);
    if (!library) give_up("cannot load", dlerror());
    free(library_path);
    return library;
}

EXPORT int cuModuleLoadDataEx(void **found, const void *image, UNUSED unsigned count, UNUSED int *options,
                              UNUSED void **values) {
    char *path;
    uint64_t hash = hash_of(image);
    const char *folder = setting("EMULATED_CUDA_DUMP", NULL);
    pthread_mutex_lock(&lock);
    if (folder) {
        mkdir(folder, 0777);
        if (asprintf(&path, "%s/%016lx.ptx", folder, hash) < 0) abort();
        write_text(path, image);
        free(path);
    }
    Module *module = calloc(1, sizeof *module);
    module->library = translated(image, hash);
    *found = module;
    pthread_mutex_unlock(&lock);
    return SUCCESS;
}
EXPORT int cuModuleLoadData(void **found, const void *image) { return cuModuleLoadDataEx(found, image, 0, NULL, NULL); }
EXPORT int cuModuleUnload(void *module) {
    free(module); /* functions of its library may still be known */
    return SUCCESS;
}
EXPORT int cuModuleGetFunction(void **found, void *module, const char *name) {
    char *symbol;
    if (asprintf(&symbol, "entry_%s", name) < 0) abort();
    const Entry *entry = dlsym(((Module *) module)->library, symbol);
    free(symbol);
    if (!entry) return NOT_FOUND;
    Function *function = calloc(1, sizeof *function);
    function->entry = entry;
    *found = function;
    return SUCCESS;
}
EXPORT int cuFuncSetAttribute(UNUSED void *function, UNUSED int attribute, UNUSED int value) { return SUCCESS; }
EXPORT int cuOccupancyMaxPotentialBlockSize(int *grid, int *block, UNUSED void *function, UNUSED void *shared_of,
                                            UNUSED size_t shared, UNUSED int limit) {
    *grid = 132;
    *block = 256;
    return SUCCESS;
}

/* A copy of a launch's arguments, given in one buffer or one by one. */
static uint8_t *arguments(const Entry *entry, void **params, void **extra) {
    enum { BUFFER = 1, BUFFER_SIZE = 2 }; /* CU_LAUNCH_PARAM_*, cuda.h */
    const void *buffer = NULL;
    size_t size = 0;
    for (int i = 0; extra && extra[i]; i += 2) {
        if (extra[i] == (void *) BUFFER) buffer = extra[i + 1];
        if (extra[i] == (void *) BUFFER_SIZE) size = *(size_t *) extra[i + 1];
    }
    uint8_t *copy = calloc(1, (size > entry->param_bytes ? size : entry->param_bytes) + 1);
    if (buffer) memcpy(copy, buffer, size);
    for (uint32_t i = 0; !buffer && i < entry->param_count; i++)
        memcpy(copy + entry->param_offset[i], params[i], entry->param_size[i]);
    return copy;
}

EXPORT int cuLaunchKernel(void *function, unsigned gx, unsigned gy, unsigned gz, unsigned bx, unsigned by, unsigned bz,
                          unsigned shared, UNUSED void *stream, void **params, void **extra) {
    const Entry *entry = ((Function *) function)->entry;
    pthread_mutex_lock(&lock);
    counts[LAUNCHES]++;
    uint8_t *copy = arguments(entry, params, extra);
    Launch launch = {entry, copy, {gx, gy, gz}, {bx, by, bz}, shared};
    if (state != IDLE) execute(&launch);
    free(copy);
    pthread_mutex_unlock(&lock);
    return SUCCESS;
}

/* ---- What Dr.Jit looks up, but this project has no use for ------------------------------------------------------ */

#define ABSENT(name) EXPORT int name() { return NOT_SUPPORTED; }
ABSENT(cuArrayCreate_v2) ABSENT(cuArray3DCreate_v2) ABSENT(cuArray3DGetDescriptor_v2) ABSENT(cuArrayDestroy)
ABSENT(cuTexObjectCreate) ABSENT(cuTexObjectGetResourceDesc) ABSENT(cuTexObjectDestroy)
ABSENT(cuSurfObjectCreate) ABSENT(cuSurfObjectDestroy) ABSENT(cuMemcpy2DAsync_v2) ABSENT(cuMemcpy3DAsync_v2)
ABSENT(cuProfilerStart) ABSENT(cuProfilerStop)
ABSENT(cuGraphicsGLRegisterBuffer) ABSENT(cuGraphicsGLRegisterImage) ABSENT(cuGraphicsUnregisterResource)
ABSENT(cuGraphicsMapResources) ABSENT(cuGraphicsUnmapResources) ABSENT(cuGraphicsSubResourceGetMappedArray)
ABSENT(cuGraphicsResourceGetMappedPointer)
