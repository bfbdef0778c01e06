#include "strikers.h"

static bool all_home(const struct strikers *s)
{
    return (s->home & s->fitted) == s->fitted;
}

void strikers_start(struct strikers *s, uint8_t count)
{
    s->phase = STRIKERS_LOST;
    s->fitted = (uint8_t)((1u << count) - 1u);
    s->home = s->sample = s->equal = s->channel = 0;
    s->passed = 0;
}

void strikers_prove(struct strikers *s)
{
    if (s->phase == STRIKERS_LOST && all_home(s))
        s->phase = STRIKERS_AT_MOUNTS;
}

void strikers_released(struct strikers *s, uint8_t channel)
{
    s->phase = STRIKERS_LEAVING;
    s->channel = channel;
    s->passed = 0;
}

void strikers_tick(struct strikers *s, uint8_t closed)
{
    if (closed != s->sample) {
        s->sample = closed;
        s->equal = 1;
    } else if (s->equal < STRIKER_SETTLE_MS) {
        s->equal++;
    }
    if (s->equal == STRIKER_SETTLE_MS)
        s->home = closed;
    uint8_t bit = (uint8_t)(1u << s->channel);
    switch (s->phase) {
    case STRIKERS_LEAVING:
    case STRIKERS_AWAY:
        s->passed++;
        if (!(s->home & bit))
            s->phase = STRIKERS_AWAY;
        if (s->phase == STRIKERS_AWAY && all_home(s))
            s->phase = STRIKERS_AT_MOUNTS;
        else if (s->passed >= (s->phase == STRIKERS_LEAVING ? STRIKER_LEAVE_MS : STRIKER_RETURN_MS) ||
                 ((s->home | bit) & s->fitted) != s->fitted)
            s->phase = STRIKERS_LOST; /* blocked, stuck switch, or another striker moved */
        break;
    case STRIKERS_AT_MOUNTS:
        if (!all_home(s))
            s->phase = STRIKERS_LOST;
        break;
    default:
        break;
    }
}

enum drive_status strikers_status(const struct strikers *s)
{
    switch (s->phase) {
    case STRIKERS_AT_MOUNTS:
        return DRIVE_THERE;
    case STRIKERS_LOST:
        return DRIVE_UNKNOWN;
    default:
        return DRIVE_MOVING;
    }
}
