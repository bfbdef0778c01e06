/* The spring's carriage, its motor and its switch as a model, for the boards of the tests. */
#ifndef CARRIAGE_H
#define CARRIAGE_H

#include <stdbool.h>
#include <stdint.h>

struct carriage {
    double place;        /* true place, steps from where the switch closes */
    bool powered;        /* the motor's supply; the emergency stop cuts it */
    bool enabled;        /* the motor's enable input */
    double back_drive;   /* speed with which the spring pushes it back while the motor is off, steps/s */
    uint32_t lose;       /* so many steps to come move nothing */
    int stuck;           /* the switch: 0 works, 1 stuck closed, -1 stuck open */
    double hysteresis;   /* it opens so many steps behind where it closes */
    uint32_t bounce_us;  /* how long it bounces after a change */
    bool closed;         /* without the bouncing */
    uint32_t bouncing_us;
    uint32_t noise;      /* state of the random numbers */
};

void carriage_start(struct carriage *c, double place, uint32_t seed);
void carriage_step(struct carriage *c, bool outward);
void carriage_wait(struct carriage *c, uint32_t microseconds);
/* The switch as the board's input sees it now. */
bool carriage_at_front(struct carriage *c);

#endif
