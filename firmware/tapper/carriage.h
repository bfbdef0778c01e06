/* Model of the spring's carriage, its motor and its switch, for the boards of the tests. */
#ifndef CARRIAGE_H
#define CARRIAGE_H

#include <stdbool.h>
#include <stdint.h>

struct carriage {
    double place;        /* true position, steps from where the switch closes */
    bool powered;        /* the motor's supply; the emergency stop cuts it */
    bool enabled;        /* the motor's enable input */
    double back_drive;   /* speed at which the spring moves the carriage, motor off, steps/s */
    uint32_t lose;       /* number of next steps that are lost */
    int stuck;           /* the switch: 0 works, 1 stuck closed, -1 stuck open */
    double hysteresis;   /* steps from where the switch closes to where it opens */
    uint32_t bounce_us;  /* duration of the switch's bouncing after a change */
    bool closed;         /* state of the switch without bouncing */
    uint32_t bouncing_us;
    uint32_t noise;      /* state of the random numbers */
};

void carriage_start(struct carriage *c, double place, uint32_t seed);
void carriage_step(struct carriage *c, bool outward);
void carriage_wait(struct carriage *c, uint32_t microseconds);
/* Return the current level of the switch, including bouncing. */
bool carriage_at_front(struct carriage *c);

#endif
