#include "carriage.h"

#define FRONT_END (-80.0) /* mechanical end of the travel; steps beyond it have no effect */

static void look(struct carriage *c)
{
    bool closed = c->closed ? c->place < c->hysteresis : c->place <= 0.0;
    if (closed != c->closed)
        c->bouncing_us = c->bounce_us;
    c->closed = closed;
}

void carriage_start(struct carriage *c, double place, uint32_t seed)
{
    *c = (struct carriage){.place = place,
                           .powered = true,
                           .back_drive = 4000.0,
                           .hysteresis = 24.0,
                           .bounce_us = 1500,
                           .noise = seed | 1u};
    c->closed = place <= 0.0;
}

void carriage_step(struct carriage *c, bool outward)
{
    if (!c->powered || !c->enabled)
        return;
    if (c->lose) {
        c->lose--;
        return;
    }
    if (outward || c->place > FRONT_END)
        c->place += outward ? 1.0 : -1.0;
    look(c);
}

void carriage_wait(struct carriage *c, uint32_t microseconds)
{
    c->bouncing_us = c->bouncing_us > microseconds ? c->bouncing_us - microseconds : 0;
    if (c->powered && c->enabled)
        return;
    if (c->place > 0.0) {
        c->place -= c->back_drive * microseconds * 1e-6;
        if (c->place < 0.0)
            c->place = 0.0;
    }
    look(c);
}

bool carriage_at_front(struct carriage *c)
{
    if (c->stuck)
        return c->stuck > 0;
    if (c->bouncing_us) {
        c->noise = c->noise * 1664525u + 1013904223u;
        return (c->noise >> 30) & 1u;
    }
    return c->closed;
}
