/* Control of the spring's carriage by steps and its front switch, independent of the hardware.
 *
 * The position is known only after homing with the motor enabled, and only until the motor is
 * switched off or the switch contradicts the step count. Every return ends at the switch.
 */
#ifndef DRIVE_H
#define DRIVE_H

#include <stdbool.h>
#include <stdint.h>

#ifndef LONGEST_DRAW_STEPS
#define LONGEST_DRAW_STEPS 12000
#endif
#ifndef FRONT_HYSTERESIS_STEPS
#define FRONT_HYSTERESIS_STEPS 50 /* position from which the switch must be open */
#endif
#ifndef FRONT_SLACK_STEPS
#define FRONT_SLACK_STEPS 6 /* scatter of the switch; a missed full step is 8 of these */
#endif
#define DRIVE_LEAVE_STEPS 400   /* most steps to leave a closed switch */
#define DRIVE_SETTLE_TICKS 16u   /* equal samples after which a level is valid: 2 ms */
#define DRIVE_WAKE_TICKS 80u    /* from enabling the motor to its first step: 10 ms */

enum drive_status {
    DRIVE_THERE,  /* at its target, at a known position */
    DRIVE_MOVING,
    DRIVE_UNKNOWN /* motor off, position unknown */
};

enum drive_phase { DRIVE_OFF, DRIVE_LEAVING, DRIVE_SEEKING, DRIVE_OUT, DRIVE_BACK, DRIVE_HOLDING };

struct drive {
    enum drive_phase phase;
    int16_t place;     /* steps from the front switch; invalid in OFF, LEAVING, SEEKING */
    int16_t target;
    int16_t steps_left; /* number of steps that may still be made in LEAVING or SEEKING */
    uint8_t wait;      /* ticks until the motor is awake */
    uint8_t equal;     /* consecutive equal samples of the switch, at most DRIVE_SETTLE_TICKS */
    bool closed;       /* last sample of the switch */
    bool opened;       /* the switch has opened on the way out */
    bool step_high;
};

/* Outputs returned by drive_tick. */
#define DRIVE_ENABLE 1u
#define DRIVE_OUTWARD 2u
#define DRIVE_STEP 4u

void drive_start(struct drive *d);
void drive_home(struct drive *d);
void drive_out(struct drive *d, int16_t steps); /* only from DRIVE_THERE */
void drive_back(struct drive *d);               /* homing ends and its motor is switched off */
void drive_halt(struct drive *d);
enum drive_status drive_status(const struct drive *d);
/* Call at 8 kHz with the level of the front switch; at most every second call makes a step. */
uint8_t drive_tick(struct drive *d, bool front_closed);

#endif
