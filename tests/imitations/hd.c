/* An imitation of libHD: its symbols, a loop at about 1 kHz that calls what is scheduled, and a simulated arm.
 *
 * LOG is the file that gets what is asked of it. What goes wrong is chosen when it is compiled: NO_DEVICE, OLD (another
 * version), UNPLUGGED (while it is pressed), SATURATED (errors of forces, which end nothing), GARBAGE=NAN (positions that are not
 * numbers, or 1e9), STILL (the loop stops while it is pressed), MISSING (a function), INKWELL (not calibrated). */
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

typedef struct {
  unsigned int code;
  int internal;
  unsigned int handle;
} ErrorInfo;

#define HANDLE 7u

static FILE *file;
static unsigned int (*callback)(void *);
static void *data;
static pthread_t loop;
static volatile int running;
static volatile unsigned int error;
static int tick, framed, enabled;
#if defined(UNPLUGGED) || defined(STILL) || defined(GARBAGE)
static int pressed;
#endif
static volatile int gone, still;

static unsigned int fail(unsigned int code) {
  error = code;
  return code;
}

unsigned int hdInitDevice(const char *name) {
#ifdef NO_DEVICE
  fail(0x0302);
  return 0xFFFFFFFFu;
#else
  if (name && strcmp(name, "Left Device")) {
    fail(0x0302);
    return 0xFFFFFFFFu;
  }
  file = fopen(LOG, "w");
  setvbuf(file, NULL, _IOLBF, 0);
  fprintf(file, "open %s\n", name ? name : "default");
  return HANDLE;
#endif
}

void hdDisableDevice(unsigned int handle) {
  if (handle == HANDLE) fprintf(file, "close\n");
}
void hdMakeCurrentDevice(unsigned int handle) {
  if (handle != HANDLE) fail(0x0104);
}

#ifndef MISSING
void hdBeginFrame(unsigned int handle) {
  if (handle != HANDLE || framed) fail(0x0400);
  framed = 1;
  tick++;
}
#endif

void hdEndFrame(unsigned int handle) {
  if (handle != HANDLE || !framed) fail(0x0401);
  framed = 0;
  if (gone) fail(0x0302);
#ifdef SATURATED
  fail(tick % 2 ? 0x0201 : 0x0200);
#endif
}

void hdGetDoublev(unsigned int name, double *to) {
  switch (name) {
    case 0x2050: {
      /* Millimetres: to the right, up, towards the operator; the middle of the workspace is elsewhere. */
      double up = -1.0 + 4.0 * cos(2.0 * M_PI * tick / 2000.0);
      to[0] = 10.0 + 6.0;
      to[1] = 20.0 + up;
      to[2] = 30.0 + 4.0;
#ifdef GARBAGE
      if (pressed > 50) to[0] = to[1] = to[2] = GARBAGE;
#endif
      break;
    }
    case 0x2052: {
      /* By columns: the stylus is turned by a quarter about its y axis, so that it points to the left. */
      const double turned[16] = {0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 0, 1};
      memcpy(to, turned, sizeof turned);
      break;
    }
#ifdef SIX_AXES
    case 0x2622: *to = 170.0; break;
#endif
    case 0x2550: {
      const double box[6] = {-200, -100, -70, 200, 300, 200};
      memcpy(to, box, sizeof box);
      break;
    }
    case 0x2551: {
      const double box[6] = {-70, -40, -5, 90, 80, 65};
      memcpy(to, box, sizeof box);
      break;
    }
    case 0x2602: *to = 0.5; break;
    case 0x2603: *to = 2.9; break;
    case 0x2604: *to = 0.8; break;
    case 0x2609: *to = 0.003; break;
    default: fail(0x0100);
  }
}

void hdGetIntegerv(unsigned int name, int *to) {
  if (name == 0x2000) *to = tick % 300 < 150;
#ifdef SIX_AXES
  else if (name == 0x2554) *to = 6;
#endif
  else fail(0x0100);
}

void hdSetDoublev(unsigned int name, const double *from) {
#ifdef SIX_AXES
  if (name == 0x2701 && framed) {
    fprintf(file, "torque %.17g %.17g %.17g\n", from[0], from[1], from[2]);
    return;
  }
#endif
  if (name != 0x2700 || !framed) {
    fail(0x0102);
    return;
  }
  fprintf(file, "force %.17g %.17g %.17g\n", from[0], from[1], from[2]);
#if defined(UNPLUGGED)
  if (from[1] > 0.05 && ++pressed > 50) gone = 1;
#elif defined(GARBAGE)
  pressed += from[1] > 0.05;
#elif defined(STILL)
  if (from[1] > 0.05 && ++pressed > 50) still = 1;
#endif
}

const char *hdGetString(unsigned int name) {
  if (name == 0x2501) return "Touch";
#ifdef OLD
  if (name == 0x2500) return "2.0.66";
#else
  if (name == 0x2500) return "3.4.0";
#endif
  fail(0x0100);
  return NULL;
}

void hdEnable(unsigned int what) {
  if (what == 0x4000) enabled = 1;
  else fail(0x0100);
}

ErrorInfo hdGetError(void) {
  ErrorInfo info = {error, 0, HANDLE};
  error = 0;
  return info;
}

const char *hdGetErrorString(unsigned int code) {
  return code == 0x0302 ? "communication error" : code == 0x0600 ? "invalid license" : "error";
}

static void *run(void *unused) {
  while (running) {
    struct timespec pause = {0, 1000000};
    nanosleep(&pause, NULL);
    if (callback && !still && callback(data) == 0) callback = NULL;
  }
  return unused;
}

void hdStartScheduler(void) {
  fprintf(file, "start enabled %d\n", enabled);
  running = 1;
  pthread_create(&loop, NULL, run, NULL);
}

void hdStopScheduler(void) {
  if (!running) return;
  running = 0;
  pthread_join(loop, NULL);
  fprintf(file, "stop\n");
}

unsigned long hdScheduleAsynchronous(unsigned int (*what)(void *), void *with, unsigned short priority) {
  callback = what;
  data = with;
  return 100ul + (priority == 0xFFFF);
}

void hdUnschedule(unsigned long handle) {
  fprintf(file, "unschedule %lu\n", handle);
  callback = NULL;
}

unsigned int hdCheckCalibration(void) {
#ifdef INKWELL
  return 0x5002;
#else
  return 0x5000;
#endif
}
