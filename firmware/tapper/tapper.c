#include "tapper.h"

#include <string.h>

static const char *const STATE_NAMES[] = {"SAFE", "DRAWING", "DRAWN", "RELEASING", "STOPPED"};

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

/* A decimal number of at most `digits` digits; false if there is none or it does not fit. */
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

static void disarm(struct tapper *t)
{
    if (t->state == TAPPER_DRAWING || t->state == TAPPER_DRAWN) {
        board_relax();
        t->state = TAPPER_SAFE;
    }
}

void tapper_start(struct tapper *t, uint32_t boot, uint64_t used, uint32_t now)
{
    memset(t, 0, sizeof *t);
    t->state = TAPPER_SAFE;
    t->boot = boot;
    t->used = used;
    t->heard_at = now;
    board_relax();
}

void tapper_stop(struct tapper *t)
{
    board_relax();
    t->state = TAPPER_STOPPED;
    t->inside = false;
}

void tapper_press_clear(struct tapper *t, uint32_t now)
{
    t->pressed = true;
    t->pressed_at = now;
}

void tapper_measured(struct tapper *t, uint32_t speed_um_s)
{
    t->speed_um_s = speed_um_s;
}

void tapper_poll(struct tapper *t, uint32_t now)
{
    if (t->pressed && now - t->pressed_at > TAPPER_CLEAR_WINDOW_MS)
        t->pressed = false;
    if (t->state == TAPPER_RELEASING && !board_releasing())
        t->state = TAPPER_SAFE;
    if (t->state == TAPPER_DRAWING || t->state == TAPPER_DRAWN) {
        if (!board_interlock_closed() || now - t->heard_at >= TAPPER_SILENCE_MS ||
            now - t->armed_at >= t->timeout_ms)
            disarm(t);
        else if (t->state == TAPPER_DRAWING && board_drawn())
            t->state = TAPPER_DRAWN;
    }
}

static void reply(struct tapper *t, char *to, uint16_t session, uint16_t sequence,
                  const char *result)
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

static const char *arm(struct tapper *t, uint64_t shot, uint64_t energy, uint64_t timeout,
                       uint32_t now)
{
    if (t->state == TAPPER_STOPPED)
        return "STOPPED";
    if (!board_interlock_closed())
        return "INTERLOCK";
    if (shot <= t->fired || shot <= t->used)
        return "SPENT";
    if (t->state != TAPPER_SAFE)
        return "BUSY";
    if (energy == 0 || energy > TAPPER_MAX_ENERGY_UJ || timeout == 0 ||
        timeout > TAPPER_MAX_TIMEOUT_MS || !board_can_store((uint32_t)energy))
        return "RANGE";
    t->shot = shot;
    t->energy_uj = (uint32_t)energy;
    t->timeout_ms = (uint32_t)timeout;
    t->armed_at = now;
    /* Kept while drawing, when there is time: after a reset this shot may have been fired. */
    board_keep_used(shot);
    t->state = TAPPER_DRAWING;
    board_draw(t->energy_uj);
    return "OK";
}

static const char *fire(struct tapper *t, uint64_t shot)
{
    if (shot != 0 && shot == t->fired)
        return "FIRED";
    if (shot <= t->used || shot < t->fired)
        return "SPENT";
    if (t->state == TAPPER_STOPPED)
        return "STOPPED";
    if (!board_interlock_closed())
        return "INTERLOCK";
    if (t->state != TAPPER_DRAWN || shot != t->shot)
        return "NOT_DRAWN";
    if (!board_release())
        return "STOPPED";
    t->fired = shot;
    t->speed_um_s = 0;
    t->state = TAPPER_RELEASING;
    return "FIRED";
}

static const char *clear(struct tapper *t)
{
    if (t->state != TAPPER_STOPPED)
        return "OK";
    if (!t->pressed)
        return "NEEDS_PERSON";
    t->pressed = false;
    t->state = TAPPER_SAFE;
    return "OK";
}

/* Compares a word that ends at a comma or at the end; moves past it when it fits. */
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
    uint64_t numbers[3];
    uint8_t count = 0;
    uint8_t command;
    static const char *const WORDS[] = {"HELLO", "STATUS", "DISARM", "CLEAR", "FIRE", "ARM"};
    static const uint8_t ARGUMENTS[] = {0, 0, 0, 0, 1, 3};

    for (command = 0; command < sizeof ARGUMENTS; command++)
        if (is_word(&at, WORDS[command]))
            break;
    if (command == sizeof ARGUMENTS)
        return "UNKNOWN";
    while (*at == ',') {
        at++;
        if (count == 3 || !take_number(&at, 20, &numbers[count++]))
            return "UNKNOWN";
    }
    if (*at || count != ARGUMENTS[command])
        return "UNKNOWN";
    switch (command) {
    case 0:
        return "WELCOME";
    case 2:
        disarm(t);
        return "OK";
    case 3:
        return clear(t);
    case 4:
        return fire(t, numbers[0]);
    case 5:
        return arm(t, numbers[0], numbers[1], numbers[2], now);
    default:
        return "OK";
    }
}

static bool is_newer(const struct tapper *t, uint16_t sequence)
{
    uint16_t ahead = (uint16_t)(sequence - t->sequence);
    return !t->has_sequence || (ahead != 0 && ahead < 0x8000);
}

/* A whole line without '@' and newline. */
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
        disarm(t);
    } else if (session != t->session) {
        char answer[TAPPER_REPLY];
        reply(t, answer, (uint16_t)session, (uint16_t)sequence, "SESSION");
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
    reply(t, t->last_reply, (uint16_t)session, (uint16_t)sequence, result);
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
