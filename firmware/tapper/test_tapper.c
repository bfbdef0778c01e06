/* The firmware's logic on the host: `make test`. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "tapper.h"

void host_start(uint32_t boot, uint64_t used, uint32_t now);
void host_receive(const uint8_t *data, uint32_t length, uint32_t now);
void host_poll(uint32_t now);
void host_press_clear(uint32_t now);
void host_measured(uint32_t speed);
void host_set_interlock(int closed, uint32_t now);
void host_set_drawn(uint32_t now);
void host_end_release(uint32_t now);
void host_stop_wins(int wins);
int host_state(void);
uint32_t host_releases(void);
uint64_t host_kept(void);
const char *host_output(void);
void host_forget_output(void);

static int checks;

#define CHECK(condition)                                                                           \
    do {                                                                                           \
        checks++;                                                                                  \
        if (!(condition)) {                                                                        \
            fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #condition);                        \
            exit(1);                                                                               \
        }                                                                                          \
    } while (0)

/* Sends a body with its frame; returns what came back. */
static const char *ask(const char *body, uint32_t now)
{
    char line[120];
    snprintf(line, sizeof line, "@%s*%04X\n", body, tapper_crc(body, (uint8_t)strlen(body)));
    host_forget_output();
    host_receive((const uint8_t *)line, (uint32_t)strlen(line), now);
    return host_output();
}

static void drawn(uint64_t shot)
{
    char body[80];
    host_start(3, 0, 0);
    CHECK(strstr(ask("7,0,HELLO", 0), "@7,0,WELCOME,SAFE,0,0,1,0,0,0,3,1.0.0*"));
    snprintf(body, sizeof body, "7,1,ARM,%llu,12500,3000", (unsigned long long)shot);
    CHECK(strstr(ask(body, 10), ",OK,DRAWING,"));
    CHECK(host_kept() == shot);
    host_set_drawn(100);
    CHECK(host_state() == TAPPER_DRAWN);
}

int main(void)
{
    uint32_t before;

    CHECK(tapper_crc("123456789", 9) == 0x29B1);

    /* One shot, asked for three times, is released once. */
    drawn(9);
    before = host_releases();
    CHECK(strstr(ask("7,2,FIRE,9", 110), "@7,2,FIRED,RELEASING,9,12500,1,0,9,0,3*"));
    CHECK(strstr(ask("7,2,FIRE,9", 120), "@7,2,FIRED,RELEASING,"));
    CHECK(strstr(ask("7,3,FIRE,9", 130), "@7,3,FIRED,"));
    CHECK(host_releases() == before + 1);
    host_end_release(140);
    host_measured(350000);
    CHECK(strstr(ask("7,4,STATUS", 150), ",OK,SAFE,9,12500,1,0,9,350000,3*"));
    CHECK(strstr(ask("7,5,ARM,9,12500,3000", 160), ",SPENT,"));
    CHECK(strstr(ask("7,6,ARM,8,12500,3000", 170), ",SPENT,"));

    /* An older sequence number is not acted on, the same number with other words neither. */
    drawn(9);
    before = host_releases();
    CHECK(strstr(ask("7,5,STATUS", 110), ",OK,DRAWN,"));
    CHECK(*ask("7,4,FIRE,9", 120) == 0);
    CHECK(*ask("7,5,FIRE,9", 130) == 0);
    CHECK(host_releases() == before);
    /* A foreign session is told so. */
    CHECK(strstr(ask("8,6,FIRE,9", 140), "@8,6,SESSION,"));
    CHECK(host_releases() == before);
    /* A wrong shot, then the right one. */
    CHECK(strstr(ask("7,6,FIRE,10", 150), ",NOT_DRAWN,"));
    CHECK(strstr(ask("7,7,FIRE,9", 160), ",FIRED,"));

    /* Disarming: silence, time-out, interlock, session, stop. */
    drawn(9);
    host_poll(510);
    CHECK(host_state() == TAPPER_SAFE); /* 500 ms after the ARM at 10 */
    drawn(9);
    for (uint32_t now = 100, i = 10; now < 3010; now += 100, i++) {
        char body[40];
        CHECK(host_state() == TAPPER_DRAWN);
        snprintf(body, sizeof body, "7,%u,STATUS", (unsigned)i);
        CHECK(*ask(body, now));
    }
    host_poll(3010);
    CHECK(host_state() == TAPPER_SAFE);
    drawn(9);
    host_set_interlock(0, 110);
    CHECK(host_state() == TAPPER_SAFE);
    CHECK(strstr(ask("7,2,ARM,10,100,3000", 120), ",INTERLOCK,"));
    drawn(9);
    CHECK(strstr(ask("11,0,HELLO", 110), "@11,0,WELCOME,SAFE,"));
    drawn(9);
    host_receive((const uint8_t *)"@7,2,FI!RE,9", 12, 110);
    CHECK(host_state() == TAPPER_STOPPED);
    CHECK(strstr(ask("7,2,FIRE,9", 120), ",STOPPED,"));
    CHECK(strstr(ask("7,3,CLEAR", 130), ",NEEDS_PERSON,STOPPED,"));
    host_press_clear(140);
    host_poll(10141);
    CHECK(strstr(ask("7,4,CLEAR", 10150), ",NEEDS_PERSON,"));
    host_press_clear(10160);
    CHECK(strstr(ask("7,5,CLEAR", 10170), ",OK,SAFE,"));

    /* A stop that comes between the decision and the pulse: not fired, and not said to be. */
    drawn(9);
    host_stop_wins(1);
    CHECK(strstr(ask("7,2,FIRE,9", 110), ",STOPPED,DRAWN,9,12500,1,0,0,"));

    /* The clock wraps. */
    host_start(3, 0, 0xFFFFFF00u);
    ask("7,0,HELLO", 0xFFFFFF00u);
    ask("7,1,ARM,9,12500,3000", 0xFFFFFF10u);
    host_set_drawn(0x00000010u);
    CHECK(host_state() == TAPPER_DRAWN);
    host_poll(0xFFFFFF10u + 500u);
    CHECK(host_state() == TAPPER_SAFE);

    /* A shot drawn before a reset may have been fired: it is spent. */
    host_start(4, 9, 0);
    ask("7,0,HELLO", 0);
    CHECK(strstr(ask("7,1,ARM,9,12500,3000", 10), ",SPENT,SAFE,"));
    CHECK(strstr(ask("7,2,FIRE,9", 10), ",SPENT,SAFE,"));
    CHECK(strstr(ask("7,3,ARM,10,12500,3000", 10), ",OK,DRAWING,"));
    CHECK(strstr(ask("7,4,ARM,11,12500,3000", 20), ",BUSY,"));

    /* What is not a frame, is not taken. */
    host_start(5, 0, 0);
    ask("7,0,HELLO", 0);
    {
        static const char *const BODIES[] = {
            "7,1,ARM,9,12500", "7,2,ARM,9,12500,3000,1", "7,3,ARM,9,,3000", "7,4,ARM,x,1,1",
            "7,5,FIRE", "7,6,FIRE,99999999999999999999", "7,7,FIREX,1", "7,8,", "7,9,STATUS,",
        };
        for (unsigned i = 0; i < sizeof BODIES / sizeof BODIES[0]; i++) {
            CHECK(strstr(ask(BODIES[i], 10), ",UNKNOWN,"));
            CHECK(host_state() == TAPPER_SAFE);
        }
        CHECK(strstr(ask("7,20,ARM,1,0,3000", 10), ",RANGE,"));
        CHECK(strstr(ask("7,21,ARM,1,1000001,3000", 10), ",RANGE,"));
        CHECK(strstr(ask("7,22,ARM,1,1,10001", 10), ",RANGE,"));
        CHECK(*ask("0,1,HELLO", 10) == 0);
        CHECK(*ask("70000,1,HELLO", 10) == 0);
    }
    /* Noise of every kind leaves it listening and safe. */
    srand(1);
    for (uint32_t i = 0; i < 3000000; i++) {
        uint8_t byte = (uint8_t)(rand() >> 7);
        if (i % 7 == 0)
            byte = (uint8_t)"@*,\nA0"[rand() % 6];
        if (byte != '!')
            host_receive(&byte, 1, 20 + i / 100);
        if (i % 1000 == 0)
            host_forget_output();
        (void)host_output();
    }
    CHECK(host_state() == TAPPER_SAFE);
    CHECK(strstr(ask("12,1,HELLO", 40000), ",WELCOME,"));

    printf("tapper firmware: %d checks passed\n", checks);
    return 0;
}
