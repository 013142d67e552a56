// SPDX-License-Identifier: Apache-2.0
// For wheels (GGSLAM_PORTABLE): what the C++ library asks of glibc under the newest versions of its symbols, answered
// by the oldest ones, which every glibc has. scripts/tools/check_wheel_file.py refuses a wheel in which one is missing
// here. The functions are the same under both versions: glibc 2.34 moved them from libpthread to libc.
#include <pthread.h>

#if defined(__x86_64__)
#define GGSLAM_OLDEST "GLIBC_2.2.5"
#elif defined(__aarch64__)
#define GGSLAM_OLDEST "GLIBC_2.17"
#else
#error "name the oldest version of glibc's symbols on this processor"
#endif

__asm__(".symver oldest_create, pthread_create@" GGSLAM_OLDEST);
__asm__(".symver oldest_join, pthread_join@" GGSLAM_OLDEST);
__asm__(".symver oldest_once, pthread_once@" GGSLAM_OLDEST);
__asm__(".symver oldest_key_create, __pthread_key_create@" GGSLAM_OLDEST);

extern "C" {

int oldest_create(pthread_t*, const pthread_attr_t*, void* (*)(void*), void*);
int oldest_join(pthread_t, void**);
int oldest_once(pthread_once_t*, void (*)());
int oldest_key_create(pthread_key_t*, void (*)(void*));

// Since glibc 2.32 it tells std::shared_ptr whether counts need no atomic operations; "no" is always right.
char __libc_single_threaded = 0;

int pthread_create(pthread_t* thread, const pthread_attr_t* attributes, void* (*run)(void*), void* argument) noexcept {
  return oldest_create(thread, attributes, run, argument);
}

int pthread_join(pthread_t thread, void** result) { return oldest_join(thread, result); }

int pthread_once(pthread_once_t* once, void (*run)()) { return oldest_once(once, run); }

int __pthread_key_create(pthread_key_t* key, void (*destroy)(void*)) noexcept {
  return oldest_key_create(key, destroy);
}

}  // extern "C"
