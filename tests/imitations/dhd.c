/* An imitation of libdhd: its symbols, and a simulated arm that presses and comes back without end.
 *
 * LOG is the file that gets what is asked of it. What goes wrong is chosen when it is compiled: NO_DEVICE, VERSION=2,
 * UNPLUGGED (while it is pressed), SATURATED (the returns 1 and 2, which are no errors), GARBAGE=NAN (positions that are
 * not numbers, from then on, or 1e9; PRESSED=51: at once), MISSING (a function). With SIX_AXES it is a sigma.7, whose handle is
 * turned by a quarter about its z axis. */
#include <math.h>
#include <stdio.h>

#ifndef VERSION
#define VERSION 3
#endif

static FILE *file;
#ifndef PRESSED
#define PRESSED 0
#endif
#if defined(UNPLUGGED) || defined(GARBAGE)
static int pressed = PRESSED;
#endif
static int gone;
static const char *last = "no error";

/* The tick of the arm: it moves by what it is asked, not by the clock, so that a slow machine sees the same course. */
static int tick;

static int fail(const char *why) {
  last = why;
  return -1;
}

static int wrong(char id) { return id != 5; }

int dhdGetDeviceCount(void) {
#ifdef NO_DEVICE
  return 0;
#else
  return 1;
#endif
}

int dhdOpen(void) {
#ifdef NO_DEVICE
  return fail("no device found");
#else
  file = fopen(LOG, "w");
  setvbuf(file, NULL, _IOLBF, 0);
  fprintf(file, "open\n");
  /* Not 0: every call must name it. */
  return 5;
#endif
}

int dhdOpenID(char id) { return id == 1 ? dhdOpen() : fail("invalid index"); }

int dhdClose(char id) {
  if (wrong(id)) return fail("invalid device");
  fprintf(file, "close\n");
  return 0;
}

int dhdEnableForce(unsigned char on, char id) {
  if (wrong(id)) return fail("invalid device");
  fprintf(file, "enable %d\n", on);
  return 0;
}

#ifdef SIX_AXES
int dhdGetSystemType(char id) { return wrong(id) ? -1 : 104; }
const char *dhdGetSystemName(char id) { return wrong(id) ? NULL : "sigma.7"; }

int dhdGetOrientationFrame(double rows[3][3], char id) {
  static const double turned[3][3] = {{0, -1, 0}, {1, 0, 0}, {0, 0, 1}};
  if (wrong(id)) return fail("invalid device");
  for (int row = 0; row < 3; row++)
    for (int column = 0; column < 3; column++) rows[row][column] = turned[row][column];
  return 0;
}

int dhdGetGripperAngleRad(double *angle, char id) {
  if (wrong(id)) return fail("invalid device");
  *angle = 0.4;
  return 0;
}

int dhdSetForceAndTorque(double x, double y, double z, double tx, double ty, double tz, char id) {
  if (wrong(id)) return fail("invalid device");
  fprintf(file, "force %.17g %.17g %.17g\n", x, y, z);
  fprintf(file, "torque %.17g %.17g %.17g\n", tx, ty, tz);
  return 0;
}
#else
int dhdGetSystemType(char id) { return wrong(id) ? -1 : 33; }
const char *dhdGetSystemName(char id) { return wrong(id) ? NULL : "omega.3"; }
#endif
double dhdGetMaxForce(char id) { return wrong(id) ? 0.0 : 9.0; }

int dhdSetMaxForce(double force_n, char id) {
  if (wrong(id)) return fail("invalid device");
  fprintf(file, "most %.17g\n", force_n);
  return 0;
}

void dhdGetSDKVersion(int *major, int *minor, int *release, int *revision) {
  *major = VERSION;
  *minor = 17;
  *release = *revision = 0;
}

int dhdGetPosition(double *x, double *y, double *z, char id) {
  if (wrong(id)) return fail("invalid device");
  if (gone) return fail("communication error");
  tick++;
  *x = 0.004;
  *y = 0.006;
  *z = -0.001 + 0.004 * cos(2.0 * M_PI * tick / 2000.0);
#ifdef GARBAGE
  if (pressed > 50) *x = *y = *z = GARBAGE;
#endif
  fprintf(file, "place %.17g %.17g %.17g\n", *x, *y, *z);
#ifdef SATURATED
  return 1;
#else
  return 0;
#endif
}

int dhdGetButton(int index, char id) {
  if (wrong(id)) return fail("invalid device");
  /* It has one button. */
  return index == 0 ? tick % 300 < 150 : fail("invalid index");
}

#ifndef MISSING
int dhdSetForce(double x, double y, double z, char id) {
  if (wrong(id)) return fail("invalid device");
  fprintf(file, "force %.17g %.17g %.17g\n", x, y, z);
  if (gone) return fail("communication error");
#ifdef UNPLUGGED
  if (z > 0.05 && ++pressed > 50) gone = 1;
#endif
#ifdef GARBAGE
  pressed += z > 0.05;
#endif
#ifdef SATURATED
  return 2;
#else
  return 0;
#endif
}
#endif

const char *dhdErrorGetLastStr(void) { return last; }
