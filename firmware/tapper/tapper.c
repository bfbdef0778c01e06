#include "tapper.h"

#include <string.h>

static const char *const STATE_NAMES[] = {"UNHOMED",  "HOMING",    "SAFE",        "CHARGING",
                                          "CHARGED", "RELEASING", "DISCHARGING", "STOPPED"};

uint16_t tapper_crc(const char *data, uint8_t length)
{
    /* CRC-16/CCITT-FALSE. */
    uint16_t value = 0xFFFF;
    while (length--) {
        value ^= (uint16_t)((uint8_t)*data++) << 8;
        for (uint8_t bit = 0; bit < 8; bit++)
            value = (value & 0x8000) ? (uint16_t)(value << 1) ^ 0x1021 : (uint16_t)(value << 1);
    }
    return value;
}

static char *put_text(char *to, const char *text)
{
    while (*text)
        *to++ = *text++;
    return to;
}

static char *put_number(char *to, uint64_t value)
{
    char digits[20];
    uint8_t count = 0;
    do {
        digits[count++] = (char)('0' + value % 10);
        value /= 10;
    } while (value);
    while (count)
        *to++ = digits[--count];
    return to;
}

static char *put_hex(char *to, uint16_t value)
{
    for (int8_t shift = 12; shift >= 0; shift -= 4)
        *to++ = "0123456789ABCDEF"[(value >> shift) & 0xF];
    return to;
}

/* Read a decimal number of at most `digits` digits; false if it is missing or too large. */
static bool take_number(const char **from, uint8_t digits, uint64_t *value)
{
    const char *at = *from;
    uint64_t sum = 0;
    uint8_t count = 0;
    while (*at >= '0' && *at <= '9') {
        uint8_t digit = (uint8_t)(*at - '0');
        if (++count > digits || sum > (UINT64_MAX - digit) / 10)
            return false;
        sum = sum * 10 + digit;
        at++;
    }
    *from = at;
    *value = sum;
    return count > 0;
}

static bool holds_energy(const struct tapper *t)
{
    return t->state == TAPPER_CHARGING || t->state == TAPPER_CHARGED;
}

static void discharge(struct tapper *t)
{
    if (holds_energy(t)) {
        board_discharge();
        t->state = TAPPER_DISCHARGING;
    } else if (t->state == TAPPER_HOMING) {
        board_halt();
        t->state = TAPPER_UNHOMED;
    }
}

/* Set the state according to the drive: `there` after a motion, `moving` during it. */
static void settle(struct tapper *t, enum tapper_state there, enum tapper_state moving)
{
    switch (board_drive()) {
    case DRIVE_THERE:
        t->state = there;
        break;
    case DRIVE_MOVING:
        t->state = moving;
        break;
    default:
        t->state = TAPPER_UNHOMED;
    }
}

void tapper_start(struct tapper *t, uint32_t boot, uint64_t used, uint32_t now)
{
    memset(t, 0, sizeof *t);
    t->boot = boot;
    t->shot = used;
    t->setup = true;
    t->heard_at = now;
    t->button = true; /* a button stuck since the start has no effect */
    /* Nothing moves automatically after a start; the carriage is homed on request of the host. */
    board_halt();
    settle(t, TAPPER_SAFE, TAPPER_SAFE);
}

void tapper_stop(struct tapper *t, bool by_wire)
{
    if (by_wire || t->state == TAPPER_HOMING)
        board_halt();
    else
        board_discharge();
    t->state = TAPPER_STOPPED;
    t->press = PRESS_FOR_NOTHING;
    t->acknowledged = false;
    if (!by_wire) /* an open stop loop stops every millisecond; frames must still be received */
        t->inside = false;
}

/* A press takes effect when the button is released, so a button held down or stuck has none. */
void tapper_button(struct tapper *t, bool pressed, uint32_t now)
{
    if (pressed == t->button)
        return;
    t->button = pressed;
    if (pressed) {
        t->pressed_at = now;
        t->press = t->state == TAPPER_STOPPED                                    ? PRESS_TO_CLEAR
                   : t->state == TAPPER_SAFE || t->state == TAPPER_UNHOMED ? PRESS_TO_FORGET
                                                                                 : PRESS_FOR_NOTHING;
    } else if (t->press == PRESS_TO_CLEAR && now - t->pressed_at >= TAPPER_PRESS_MS) {
        t->acknowledged = true;
        t->acknowledged_at = now;
    } else if (t->press == PRESS_TO_FORGET && now - t->pressed_at >= TAPPER_FORGET_MS) {
        /* End the session as after a start, so that nobody gets an answer about an old shot. */
        t->boot = board_forget_used();
        t->shot = t->fired = 0;
        t->session = 0;
        t->setup = true;
    }
}

void tapper_measured(struct tapper *t, uint32_t speed_um_s)
{
    t->speed_um_s = speed_um_s;
}

static bool silent(const struct tapper *t, uint32_t now)
{
    return now - t->heard_at >= TAPPER_SILENCE_MS;
}

static bool too_much_for_setup(const struct tapper *t, uint64_t energy_uj)
{
    return t->setup && energy_uj > TAPPER_SETUP_ENERGY_UJ && !board_enabled();
}

void tapper_poll(struct tapper *t, uint32_t now)
{
    if (t->acknowledged && now - t->acknowledged_at > TAPPER_CLEAR_WINDOW_MS)
        t->acknowledged = false;
    switch (t->state) {
    case TAPPER_HOMING:
        if (!board_interlock_closed() || silent(t, now))
            discharge(t);
        else
            settle(t, TAPPER_SAFE, TAPPER_HOMING);
        break;
    case TAPPER_CHARGING:
    case TAPPER_CHARGED:
        if (!board_interlock_closed() || silent(t, now) || now - t->charged_at >= t->timeout_ms ||
            too_much_for_setup(t, t->energy_uj))
            discharge(t);
        else
            settle(t, TAPPER_CHARGED, TAPPER_CHARGING);
        break;
    case TAPPER_RELEASING:
        if (board_releasing())
            break;
        board_discharge(); /* the carriage returns to fetch the striker */
        t->state = TAPPER_DISCHARGING;
        /* fall through */
    case TAPPER_DISCHARGING:
        settle(t, TAPPER_SAFE, TAPPER_DISCHARGING);
        break;
    case TAPPER_SAFE: /* a striker may be pulled off its mount by hand */
        settle(t, TAPPER_SAFE, TAPPER_SAFE);
        break;
    default:
        break;
    }
}

static void reply(struct tapper *t, char *to, uint16_t session, uint16_t sequence,
                  const char *result, uint32_t now)
{
    char *at = to;
    *at++ = '@';
    at = put_number(at, session);
    *at++ = ',';
    at = put_number(at, sequence);
    *at++ = ',';
    at = put_text(at, result);
    *at++ = ',';
    at = put_text(at, STATE_NAMES[t->state]);
    *at++ = ',';
    at = put_number(at, t->shot);
    *at++ = ',';
    at = put_number(at, t->energy_uj);
    at = put_text(at, board_interlock_closed() ? ",1," : ",0,");
    at = put_text(at, t->state == TAPPER_STOPPED ? "1," : "0,");
    at = put_number(at, t->fired);
    *at++ = ',';
    at = put_number(at, t->speed_um_s);
    *at++ = ',';
    at = put_number(at, t->boot);
    *at++ = ',';
    at = put_number(at, now);
    at = put_text(at, t->setup ? ",SETUP," : ",RUN,");
    *at++ = board_enabled() ? '1' : '0';
    *at++ = ',';
    at = put_number(at, t->channel);
    *at++ = ',';
    at = put_number(at, board_channels());
    *at++ = ',';
    at = put_number(at, board_at_mounts());
    if (strcmp(result, "WELCOME") == 0) {
        *at++ = ',';
        at = put_text(at, TAPPER_VERSION);
    }
    uint16_t crc = tapper_crc(to + 1, (uint8_t)(at - to - 1));
    *at++ = '*';
    at = put_hex(at, crc);
    *at++ = '\n';
    *at = 0;
    board_send(to);
}

static const char *home(struct tapper *t)
{
    if (t->state == TAPPER_STOPPED)
        return "STOPPED";
    if (!board_interlock_closed())
        return "INTERLOCK";
    if (t->state != TAPPER_UNHOMED && t->state != TAPPER_SAFE)
        return "BUSY";
    t->press = PRESS_FOR_NOTHING;
    board_home();
    settle(t, TAPPER_SAFE, TAPPER_HOMING);
    return "OK";
}

static const char *charge(struct tapper *t, uint64_t shot, uint64_t energy, uint64_t timeout,
                          uint64_t channel, uint32_t now)
{
    if (t->state == TAPPER_STOPPED)
        return "STOPPED";
    if (!board_interlock_closed())
        return "INTERLOCK";
    if (shot <= t->shot)
        return "SPENT";
    if (shot - t->shot > TAPPER_MAX_JUMP)
        return "JUMP";
    if (t->state == TAPPER_UNHOMED)
        return "NOT_HOMED";
    if (t->state != TAPPER_SAFE)
        return "BUSY";
    if (energy == 0 || energy > TAPPER_MAX_ENERGY_UJ || timeout == 0 ||
        timeout > TAPPER_MAX_TIMEOUT_MS || !board_can_store((uint32_t)energy))
        return "RANGE";
    if (channel >= board_channels())
        return "CHANNEL";
    if (too_much_for_setup(t, energy))
        return "NOT_ENABLED";
    t->shot = shot;
    t->channel = (uint8_t)channel;
    t->energy_uj = (uint32_t)energy;
    t->timeout_ms = (uint32_t)timeout;
    t->charged_at = now;
    t->press = PRESS_FOR_NOTHING;
    /* Store the number before charging, because after a reset this shot may have been fired. */
    board_keep_used(shot);
    t->state = TAPPER_CHARGING;
    board_charge(t->energy_uj, t->channel);
    return "OK";
}

bool tapper_in_window(uint32_t deadline, uint32_t now)
{
    uint32_t ahead = deadline - now;
    return ahead != 0 && ahead <= TAPPER_LONGEST_WINDOW_MS;
}

static const char *fire(struct tapper *t, uint64_t shot, uint64_t deadline, uint64_t channel)
{
    if (shot != 0 && shot == t->fired)
        return "FIRED";
    if (t->state == TAPPER_STOPPED)
        return "STOPPED";
    if (!board_interlock_closed())
        return "INTERLOCK";
    if (shot != t->shot || t->state != TAPPER_CHARGED)
        return shot < t->shot ? "SPENT" : "NOT_CHARGED";
    if (channel != t->channel)
        return "CHANNEL";
    if (deadline > UINT32_MAX)
        return "UNKNOWN";
    switch (board_release((uint32_t)deadline)) {
    case RELEASE_STOPPED:
        return "STOPPED";
    case RELEASE_LATE:
        discharge(t);
        return "LATE";
    default:
        break;
    }
    t->fired = shot;
    t->speed_um_s = 0;
    t->state = TAPPER_RELEASING;
    return "FIRED";
}

static const char *clear(struct tapper *t)
{
    if (t->state != TAPPER_STOPPED)
        return "OK";
    if (!t->acknowledged)
        return "NEEDS_PERSON";
    t->acknowledged = false;
    settle(t, TAPPER_SAFE, TAPPER_DISCHARGING);
    return "OK";
}

/* Compare a word that ends at a comma or at the end of the text; skip it if it matches. */
static bool is_word(const char **from, const char *word)
{
    size_t length = strlen(word);
    if (strncmp(*from, word, length) != 0)
        return false;
    if ((*from)[length] != 0 && (*from)[length] != ',')
        return false;
    *from += length;
    return true;
}

static const char *act(struct tapper *t, const char *at, uint32_t now)
{
    uint64_t numbers[4] = {0};
    uint8_t count = 0;
    uint8_t command;
    static const char *const WORDS[] = {"HELLO", "STATUS",    "HOME", "DISCHARGE", "CLEAR",
                                        "FIRE",  "CHARGE", "MODE"};
    static const uint8_t ARGUMENTS[] = {0, 0, 0, 0, 0, 2, 3, 0};

    for (command = 0; command < sizeof ARGUMENTS; command++)
        if (is_word(&at, WORDS[command]))
            break;
    if (command == sizeof ARGUMENTS)
        return "UNKNOWN";
    if (command == 7) {
        bool setup = strcmp(at, ",SETUP") == 0;
        if (!setup && strcmp(at, ",RUN") != 0)
            return "UNKNOWN";
        t->setup = setup;
        return "OK";
    }
    while (*at == ',') {
        at++;
        if (count == 4 || !take_number(&at, 20, &numbers[count++]))
            return "UNKNOWN";
    }
    /* A channel may follow the arguments of FIRE and CHARGE; without it, the channel is 0. */
    bool names_channel = command >= 5 && count == ARGUMENTS[command] + 1;
    if (*at || (count != ARGUMENTS[command] && !names_channel))
        return "UNKNOWN";
    switch (command) {
    case 0:
        return "WELCOME";
    case 2:
        return home(t);
    case 3:
        discharge(t);
        return "OK";
    case 4:
        return clear(t);
    case 5:
        return fire(t, numbers[0], numbers[1], names_channel ? numbers[2] : 0);
    case 6:
        return charge(t, numbers[0], numbers[1], numbers[2], names_channel ? numbers[3] : 0, now);
    default:
        return "OK";
    }
}

static bool is_newer(const struct tapper *t, uint16_t sequence)
{
    uint16_t ahead = (uint16_t)(sequence - t->sequence);
    return !t->has_sequence || (ahead != 0 && ahead < 0x8000);
}

/* Process a whole line without '@' and newline. */
static void frame(struct tapper *t, uint32_t now)
{
    char check[5];
    uint64_t session, sequence;
    const char *at = t->line;

    if (t->length < 6 || t->line[t->length - 5] != '*')
        return;
    *put_hex(check, tapper_crc(t->line, (uint8_t)(t->length - 5))) = 0;
    if (strcmp(check, t->line + t->length - 4) != 0)
        return;
    t->line[t->length - 5] = 0;
    if (!take_number(&at, 5, &session) || *at++ != ',' || !take_number(&at, 5, &sequence) ||
        *at++ != ',' || session == 0 || session > 0xFFFF || sequence > 0xFFFF)
        return;

    const char *word = at;
    if (is_word(&word, "HELLO") && (session != t->session || is_newer(t, (uint16_t)sequence))) {
        t->session = (uint16_t)session;
        t->setup = true;
        discharge(t);
    } else if (session != t->session) {
        char answer[TAPPER_REPLY];
        reply(t, answer, (uint16_t)session, (uint16_t)sequence, "SESSION", now);
        return;
    } else if (t->has_sequence && sequence == t->sequence) {
        if (strcmp(t->line, t->last_body) == 0) {
            t->heard_at = now;
            board_send(t->last_reply);
        }
        return;
    } else if (!is_newer(t, (uint16_t)sequence)) {
        return;
    }
    t->heard_at = now;
    t->sequence = (uint16_t)sequence;
    t->has_sequence = true;
    strcpy(t->last_body, t->line);
    const char *result = act(t, at, now);
    reply(t, t->last_reply, (uint16_t)session, (uint16_t)sequence, result, now);
}

void tapper_byte(struct tapper *t, uint8_t byte, uint32_t now)
{
    tapper_poll(t, now);
    if (byte == '@') {
        t->inside = true;
        t->length = 0;
    } else if (!t->inside) {
        return;
    } else if (byte == '\n') {
        t->inside = false;
        t->line[t->length] = 0;
        frame(t, now);
    } else if (t->length >= TAPPER_LINE || byte == 0) {
        t->inside = false;
    } else if (byte != '\r') {
        t->line[t->length++] = (char)byte;
    }
}
