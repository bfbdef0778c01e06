/* The spring's carriage: steps, and what its front switch proves. Without a line of hardware in it.
 *
 * The place is known only after homing with the motor enabled, and only until the motor is switched off
 * or the switch contradicts the count of steps. Every way back ends at the switch.
 */
#ifndef DRIVE_H
#define DRIVE_H

#include <stdbool.h>
#include <stdint.h>

#ifndef LONGEST_DRAW_STEPS
#define LONGEST_DRAW_STEPS 12000
#endif
#ifndef FRONT_HYSTERESIS_STEPS
#define FRONT_HYSTERESIS_STEPS 50 /* from where on the switch must be open */
#endif
#ifndef FRONT_SLACK_STEPS
#define FRONT_SLACK_STEPS 6 /* scatter of the switch; a motor misses full steps: 8 of these and more */
#endif
#define DRIVE_LEAVE_STEPS 400   /* longest way off a closed switch */
#define DRIVE_SETTLE_TICKS 16u   /* equal samples of the switch that count: 2 ms */
#define DRIVE_WAKE_TICKS 80u    /* from enabling the motor to its first step: 10 ms */

enum drive_status {
    DRIVE_THERE,  /* stands where it was sent, and knows it */
    DRIVE_MOVING,
    DRIVE_UNKNOWN /* motor off; where the carriage is, is not known */
};

enum drive_phase { DRIVE_OFF, DRIVE_LEAVING, DRIVE_SEEKING, DRIVE_OUT, DRIVE_BACK, DRIVE_HOLDING };

struct drive {
    enum drive_phase phase;
    int16_t place;     /* steps from the front switch; valid but in OFF, LEAVING, SEEKING */
    int16_t target;
    int16_t steps;     /* made in LEAVING and SEEKING */
    uint8_t wait;      /* ticks until the motor is awake */
    uint8_t equal;     /* samples of the switch in a row that were the same, at most SETTLE_TICKS */
    bool closed;       /* the last of them */
    bool opened;       /* the switch has opened on the way out */
    bool step_high;
};

/* What drive_tick returns: the outputs. */
#define DRIVE_ENABLE 1u
#define DRIVE_OUTWARD 2u
#define DRIVE_STEP 4u

void drive_start(struct drive *d);
void drive_home(struct drive *d);
void drive_out(struct drive *d, int16_t steps); /* only from DRIVE_THERE */
void drive_back(struct drive *d);               /* nothing while the place is unknown */
void drive_halt(struct drive *d);
enum drive_status drive_status(const struct drive *d);
/* Call at 8 kHz, with the front switch as it is; every second call makes a step at most. */
uint8_t drive_tick(struct drive *d, bool front_closed);

#endif
