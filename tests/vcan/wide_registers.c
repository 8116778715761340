/*
 * Lets User-mode Linux run on processors with AMX. Built and preloaded into it by tests/vcan/run where needed.
 *
 * UML restores the extended registers of its processes from a buffer of 2696 bytes, which is all there is up to AVX-512
 * and PKRU. Where the processor has AMX the area is 11008 bytes, and the host's kernel takes the whole area or nothing:
 * UML dies at its first process. Here the missing end is filled with zeros and said to be unused, which it is: a process
 * has to ask its kernel for AMX, and UML's does not know the question.
 */
#define _GNU_SOURCE
#include <elf.h>
#include <errno.h>
#include <stdarg.h>
#include <stdint.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

/* Offset of the XSAVE header's bit field "components in this area". */
#define COMPONENTS_AT 512
/* Bits 17 and 18: tile configuration and tile data. */
#define AMX_COMPONENTS ((uint64_t)3 << 17)

static unsigned char area[65536] __attribute__((aligned(64)));

static long set_extended_registers(long process, const struct iovec *given)
{
    struct iovec whole = { area, sizeof area };
    uint64_t components;

    /* Asked only for its size, which the kernel writes into iov_len. */
    if (syscall(SYS_ptrace, PTRACE_GETREGSET, process, NT_X86_XSTATE, &whole) < 0)
        return -1;
    if (given->iov_len >= whole.iov_len)
        return syscall(SYS_ptrace, PTRACE_SETREGSET, process, NT_X86_XSTATE, given);
    memset(area, 0, whole.iov_len);
    memcpy(area, given->iov_base, given->iov_len);
    memcpy(&components, area + COMPONENTS_AT, sizeof components);
    components &= ~AMX_COMPONENTS;
    memcpy(area + COMPONENTS_AT, &components, sizeof components);
    return syscall(SYS_ptrace, PTRACE_SETREGSET, process, NT_X86_XSTATE, &whole);
}

/* In place of the C library's. */
long ptrace(enum __ptrace_request request, ...)
{
    va_list rest;
    long process, address, data, word, result;
    int peek = request == PTRACE_PEEKTEXT || request == PTRACE_PEEKDATA || request == PTRACE_PEEKUSER;

    va_start(rest, request);
    process = va_arg(rest, long);
    address = va_arg(rest, long);
    data = va_arg(rest, long);
    va_end(rest);

    if (request == PTRACE_SETREGSET && address == NT_X86_XSTATE)
        return set_extended_registers(process, (const struct iovec *)data);
    /* The C library returns a word where the system call stores it. */
    result = syscall(SYS_ptrace, request, process, address, peek ? (long)&word : data);
    if (peek && result >= 0) {
        errno = 0;
        return word;
    }
    return result;
}
