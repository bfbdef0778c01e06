/* Tests of the firmware's logic on the host (`make test`). */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "carriage.h"
#include "strikers.h"
#include "tapper.h"

void host_coils(int count);
void host_strikers(int flight, int do_not_move, int are_pulled, int switches_stuck);
int host_channel(void);
void host_start(uint32_t boot, uint64_t used, uint32_t now, double place, uint32_t seed);
void host_reset(uint32_t boot, uint64_t used, uint32_t now);
void host_run(uint32_t now);
void host_receive(const uint8_t *data, uint32_t length, uint32_t now);
void host_measured(uint32_t speed);
void host_interlock(int closed);
void host_enabling(int held);
void host_wire(int open);
void host_button(int pressed);
void host_stop_wins(int wins);
struct carriage *host_carriage(void);
double host_released_from(void);
int host_state(void);
uint32_t host_releases(void);
uint64_t host_kept(void);
const char *host_output(void);
void host_forget_output(void);

static int checks;
static uint32_t now;
static uint16_t sequence;

#define CHECK(condition)                                                                           \
    do {                                                                                           \
        checks++;                                                                                  \
        if (!(condition)) {                                                                        \
            fprintf(stderr, "%s:%d: %s\n", __FILE__, __LINE__, #condition);                        \
            exit(1);                                                                               \
        }                                                                                          \
    } while (0)

/* Send a body in a frame; return the answer. */
static const char *send(const char *body)
{
    char line[120];
    snprintf(line, sizeof line, "@%s*%04X\n", body, tapper_crc(body, (uint8_t)strlen(body)));
    host_forget_output();
    host_receive((const uint8_t *)line, (uint32_t)strlen(line), now);
    return host_output();
}

/* Send the next request of session 7; return the answer. */
static const char *ask(const char *words)
{
    char body[100];
    snprintf(body, sizeof body, "7,%u,%s", (unsigned)++sequence, words);
    return send(body);
}

static const char *fire(unsigned long long shot, uint32_t window)
{
    char words[60];
    snprintf(words, sizeof words, "FIRE,%llu,%lu", shot, (unsigned long)(uint32_t)(now + window));
    return ask(words);
}

static void pass(uint32_t milliseconds)
{
    now += milliseconds;
    host_run(now);
}

/* Let time pass while the host continues to query the status. */
static void keep(uint32_t milliseconds)
{
    for (uint32_t end = now + milliseconds; now != end;) {
        pass(end - now < 100 ? end - now : 100);
        CHECK(*ask("STATUS"));
    }
}

static void greet(void)
{
    CHECK(strstr(ask("HELLO"), ",WELCOME,"));
    CHECK(strstr(ask("MODE,RUN"), ",OK,"));
}

/* Start a board in run mode and home its carriage. */
static void homed(void)
{
    host_start(3, 0, now, 600.0, 1);
    greet();
    CHECK(strstr(ask("HOME"), ",OK,HOMING,"));
    keep(400);
    CHECK(host_state() == TAPPER_SAFE);
}

static void charged(unsigned long long shot)
{
    char words[60];
    homed();
    snprintf(words, sizeof words, "CHARGE,%llu,12500,3000", shot);
    CHECK(strstr(ask(words), ",OK,CHARGING,"));
    CHECK(host_kept() == shot);
    keep(400);
    CHECK(host_state() == TAPPER_CHARGED);
    CHECK(fabs(host_carriage()->place - 1414.0) < 1.5);
}

static void press_button(uint32_t milliseconds)
{
    host_button(1);
    pass(milliseconds);
    host_button(0);
    pass(2);
}

static void test_one_shot(void)
{
    char first[200], again[80];
    homed();
    CHECK(strstr(ask("HELLO"), ",WELCOME,SAFE,0,0,1,0,0,0,3,"));
    CHECK(strstr(ask("STATUS"), ",SETUP,0,0,1,0*"));
    charged(9);
    uint32_t before = host_releases();
    snprintf(again, sizeof again, "7,%u,FIRE,9,%lu", sequence + 1u, (unsigned long)(now + 40));
    strcpy(first, fire(9, 40));
    CHECK(strstr(first, ",FIRED,RELEASING,9,12500,1,0,9,0,3,"));
    pass(200);
    CHECK(strcmp(send(again), first) == 0); /* the stored answer, although the deadline passed */
    CHECK(strstr(fire(9, 40), ",FIRED,"));
    CHECK(host_releases() == before + 1);
    host_measured(350000);
    keep(600);
    CHECK(strstr(ask("STATUS"), ",OK,SAFE,9,12500,1,0,9,350000,3,"));
    CHECK(fabs(host_carriage()->place) < 1.5);
    CHECK(strstr(ask("CHARGE,9,12500,3000"), ",SPENT,"));
    CHECK(strstr(ask("CHARGE,8,12500,3000"), ",SPENT,"));
}

static void test_window(void)
{
    static const uint32_t REFUSED[] = {0, 101, 1000, 0x7FFFFFFF, 0x80000000u, (uint32_t)-1,
                                       (uint32_t)-40};
    for (unsigned i = 0; i < sizeof REFUSED / sizeof REFUSED[0]; i++) {
        charged(9);
        uint32_t before = host_releases();
        CHECK(strstr(fire(9, REFUSED[i]), ",LATE,DISCHARGING,9,"));
        /* The shot has ended and cannot be fired any more. */
        CHECK(strstr(fire(9, 50), ",NOT_CHARGED,"));
        keep(600);
        CHECK(host_state() == TAPPER_SAFE && fabs(host_carriage()->place) < 1.5);
        CHECK(strstr(ask("CHARGE,9,12500,3000"), ",SPENT,"));
        CHECK(host_releases() == before);
    }
    charged(9);
    CHECK(strstr(fire(9, 1), ",FIRED,"));
    charged(9);
    CHECK(strstr(fire(9, 100), ",FIRED,"));
    /* Repeating a request does not change its deadline, so the same frame is refused as late. */
    charged(9);
    char body[80];
    snprintf(body, sizeof body, "7,%u,FIRE,9,%lu", (unsigned)++sequence, (unsigned long)(now + 30));
    pass(30);
    CHECK(strstr(send(body), ",LATE,"));
    CHECK(strstr(send(body), ",LATE,"));
    /* Board time wraps between charging and the deadline. */
    now = 0xFFFFFFFFu - 900u;
    charged(9); /* homing and charging take 800 ms */
    pass(0xFFFFFFFFu - 20u - now);
    ask("STATUS");
    CHECK(strstr(fire(9, 60), ",FIRED,"));
    now = 0xFFFFFFFFu - 900u;
    charged(9);
    pass(0xFFFFFFFFu - 20u - now);
    snprintf(body, sizeof body, "7,%u,FIRE,9,%lu", (unsigned)++sequence, 19ul);
    pass(60);
    CHECK(strstr(send(body), ",LATE,"));
    now = 0;
}

static void test_sequence(void)
{
    char body[80];
    charged(9);
    uint32_t before = host_releases();
    snprintf(body, sizeof body, "7,%u,FIRE,9,%lu", (unsigned)sequence, (unsigned long)(now + 50));
    CHECK(*send(body) == 0); /* the last sequence number, but with another command */
    snprintf(body, sizeof body, "7,%u,FIRE,9,%lu", sequence - 1u, (unsigned long)(now + 50));
    CHECK(*send(body) == 0); /* an older sequence number */
    snprintf(body, sizeof body, "8,%u,FIRE,9,%lu", sequence + 1u, (unsigned long)(now + 50));
    CHECK(strstr(send(body), ",SESSION,"));
    CHECK(host_releases() == before);
    CHECK(strstr(fire(10, 50), ",NOT_CHARGED,"));
    CHECK(strstr(fire(8, 50), ",SPENT,"));
    CHECK(host_releases() == before);
    CHECK(strstr(fire(9, 50), ",FIRED,"));
}

static void test_discharging(void)
{
    charged(9); /* discharged after 0.5 s without messages */
    pass(499);
    CHECK(host_state() == TAPPER_CHARGED);
    pass(1);
    CHECK(host_state() == TAPPER_DISCHARGING);
    pass(600);
    CHECK(host_state() == TAPPER_SAFE && fabs(host_carriage()->place) < 1.5);

    charged(9); /* time-out of the charge */
    keep(2590);
    CHECK(host_state() == TAPPER_CHARGED);
    keep(20);
    CHECK(host_state() == TAPPER_DISCHARGING);

    charged(9); /* discharged by the interlock */
    host_interlock(0);
    pass(2);
    CHECK(host_state() == TAPPER_DISCHARGING);
    CHECK(strstr(ask("CHARGE,10,1000,3000"), ",INTERLOCK,"));
    CHECK(strstr(ask("HOME"), ",INTERLOCK,"));

    charged(9); /* discharged at the host's request */
    CHECK(strstr(ask("DISCHARGE"), ",OK,DISCHARGING,"));
    CHECK(strstr(ask("CHARGE,10,1000,3000"), ",BUSY,DISCHARGING,9,"));

    charged(9); /* discharged by another session */
    CHECK(strstr(send("11,0,HELLO"), "@11,0,WELCOME,DISCHARGING,"));

    homed(); /* discharged while charging */
    CHECK(strstr(ask("CHARGE,9,800000,3000"), ",CHARGING,"));
    pass(300);
    CHECK(strstr(ask("DISCHARGE"), ",OK,DISCHARGING,"));
    keep(700);
    CHECK(host_state() == TAPPER_SAFE && fabs(host_carriage()->place) < 1.5);
}

static void test_stop_and_clear(void)
{
    /* The stop byte is detected at any position in the stream, and the motor relaxes the spring. */
    charged(9);
    host_receive((const uint8_t *)"@7,2,FI!RE,9", 12, now);
    CHECK(host_state() == TAPPER_STOPPED);
    CHECK(strstr(fire(9, 50), ",STOPPED,"));
    CHECK(strstr(ask("CHARGE,10,1000,3000"), ",STOPPED,"));
    CHECK(strstr(ask("HOME"), ",STOPPED,"));
    CHECK(strstr(ask("CLEAR"), ",NEEDS_PERSON,STOPPED,"));
    pass(600);
    CHECK(fabs(host_carriage()->place) < 1.5);
    /* A short press, a press that is not released, and a press too long ago have no effect. */
    press_button(300);
    CHECK(strstr(ask("CLEAR"), ",NEEDS_PERSON,"));
    host_button(1);
    pass(3000);
    CHECK(strstr(ask("CLEAR"), ",NEEDS_PERSON,"));
    host_button(0);
    pass(2);
    pass(10001);
    CHECK(strstr(ask("CLEAR"), ",NEEDS_PERSON,"));
    press_button(510);
    CHECK(strstr(ask("CLEAR"), ",OK,SAFE,"));

    /* A press before the stop, or one that began before it, does not clear the stop. */
    charged(9);
    press_button(510);
    host_receive((const uint8_t *)"!", 1, now);
    CHECK(strstr(ask("CLEAR"), ",NEEDS_PERSON,"));
    press_button(510);
    CHECK(strstr(ask("CLEAR"), ",OK,"));
    host_button(1);
    pass(1000);
    host_receive((const uint8_t *)"!", 1, now);
    pass(1000);
    host_button(0);
    pass(2);
    CHECK(strstr(ask("CLEAR"), ",NEEDS_PERSON,"));
    /* The button is pressed after one stop and released after another: this does not clear the
     * stop. */
    host_button(1);
    pass(300);
    host_receive((const uint8_t *)"!", 1, now);
    pass(600);
    host_button(0);
    pass(2);
    CHECK(strstr(ask("CLEAR"), ",NEEDS_PERSON,"));
    /* A press clears only one stop. */
    press_button(510);
    host_receive((const uint8_t *)"!", 1, now);
    CHECK(strstr(ask("CLEAR"), ",NEEDS_PERSON,"));

    /* The stop input: the motor is off, and the tapper must be homed before it charges again. */
    charged(9);
    host_wire(1);
    pass(5);
    CHECK(host_state() == TAPPER_STOPPED);
    press_button(510);
    CHECK(strstr(ask("CLEAR"), ",NEEDS_PERSON,")); /* while the loop is open */
    host_wire(0);
    press_button(510);
    CHECK(strstr(ask("CLEAR"), ",OK,UNHOMED,"));
    double place = host_carriage()->place;
    keep(1000);
    CHECK(host_state() == TAPPER_UNHOMED && host_carriage()->place <= place);
    CHECK(strstr(ask("CHARGE,10,1000,3000"), ",NOT_HOMED,UNHOMED,9,"));
    CHECK(strstr(ask("HOME"), ",OK,HOMING,"));
    keep(500);
    CHECK(strstr(ask("CHARGE,10,1000,3000"), ",OK,CHARGING,"));

    /* A stop between the decision and the pulse: nothing is fired, and FIRED is not reported. */
    charged(9);
    host_stop_wins(1);
    CHECK(strstr(fire(9, 50), ",STOPPED,CHARGED,9,12500,1,0,0,"));
}

static void test_shot_numbers(void)
{
    /* A refused shot has no effect on the next one. */
    homed();
    CHECK(strstr(ask("CHARGE,18446744073709551615,1000,3000"), ",JUMP,SAFE,0,"));
    CHECK(strstr(ask("CHARGE,4294967297,1000,3000"), ",JUMP,"));
    CHECK(strstr(ask("CHARGE,5,0,3000"), ",RANGE,SAFE,0,"));
    CHECK(strstr(ask("CHARGE,4294967296,1000,3000"), ",OK,"));
    CHECK(strstr(ask("CHARGE,18446744073709551616,1000,3000"), ",UNKNOWN,"));

    /* A shot charged before a reset may have been fired, so its number is spent. */
    host_start(4, 9, now, 0.0, 1);
    greet();
    CHECK(strstr(ask("CHARGE,9,12500,3000"), ",SPENT,UNHOMED,9,"));
    CHECK(strstr(fire(9, 50), ",NOT_CHARGED,"));
    CHECK(strstr(ask("HOME"), ",OK,"));
    keep(400);
    CHECK(strstr(ask("CHARGE,10,12500,3000"), ",OK,CHARGING,"));
    CHECK(strstr(ask("CHARGE,11,12500,3000"), ",BUSY,"));

    /* Only a person can reset the count: the button is held for 5 s while the board is at rest. */
    CHECK(strstr(ask("DISCHARGE"), ",OK,"));
    keep(600);
    press_button(4900);
    CHECK(host_kept() == 10);
    press_button(5100);
    CHECK(host_kept() == 0);
    CHECK(strstr(ask("STATUS"), ",SESSION,SAFE,0,"));
    CHECK(strstr(ask("HELLO"), ",WELCOME,SAFE,0,12500,1,0,0,0,5,")); /* counts as another boot */
    ask("MODE,RUN");
    CHECK(strstr(ask("CHARGE,1,12500,3000"), ",OK,CHARGING,1,"));
    /* The count is not reset while a shot is charged, nor after a stop. */
    host_button(1);
    keep(5200);
    host_button(0);
    pass(2);
    CHECK(host_kept() == 1);
    host_receive((const uint8_t *)"!", 1, now);
    press_button(5200);
    CHECK(host_kept() == 1);
    CHECK(strstr(ask("CLEAR"), ",OK,"));
    /* The count is not reset by a press during which the board is stopped either. */
    keep(600);
    host_button(1);
    pass(100);
    host_receive((const uint8_t *)"!", 1, now);
    pass(5200);
    host_button(0);
    pass(2);
    CHECK(host_kept() == 1);
    /* Nor by a press during which homing has begun. */
    host_start(6, 9, now, 0.0, 1);
    pass(10);
    greet();
    CHECK(host_state() == TAPPER_UNHOMED);
    host_button(1);
    keep(4900);
    CHECK(strstr(ask("HOME"), ",OK,HOMING,"));
    keep(300);
    host_button(0);
    pass(2);
    CHECK(host_kept() == 9);
    /* A button that is stuck when the board starts has no effect. */
    host_button(1);
    pass(10);
    host_reset(6, 9, now);
    pass(6000);
    host_button(0);
    pass(2);
    CHECK(host_kept() == 9);
}

static void test_homing(void)
{
    /* Nothing moves after a start, and nothing is charged. */
    host_start(3, 0, now, 4000.0, 1);
    host_carriage()->back_drive = 0.0;
    greet();
    keep(500);
    CHECK(host_state() == TAPPER_UNHOMED && host_carriage()->place == 4000.0);
    CHECK(strstr(ask("CHARGE,1,1000,3000"), ",NOT_HOMED,UNHOMED,0,"));
    /* Homing from outside the switch, and from the closed switch. */
    CHECK(strstr(ask("HOME"), ",OK,HOMING,"));
    CHECK(strstr(ask("CHARGE,1,1000,3000"), ",BUSY,HOMING,"));
    keep(1200);
    CHECK(host_state() == TAPPER_SAFE && fabs(host_carriage()->place) < 1.5);
    CHECK(strstr(ask("HOME"), ",OK,HOMING,"));
    keep(300);
    CHECK(host_state() == TAPPER_SAFE && fabs(host_carriage()->place) < 1.5);
    /* Homing is ended by the host, by missing messages, and by the interlock. */
    for (int how = 0; how < 3; how++) {
        host_start(3, 0, now, 6000.0, 1);
        greet();
        CHECK(strstr(ask("HOME"), ",OK,HOMING,"));
        keep(100);
        if (how == 0) {
            CHECK(strstr(ask("DISCHARGE"), ",OK,UNHOMED,"));
        } else if (how == 1) {
            pass(500);
        } else {
            host_interlock(0);
            pass(2);
        }
        CHECK(host_state() == TAPPER_UNHOMED);
    }
    /* A motor without power, and a switch that is stuck. */
    static const double PLACES[] = {0.0, 2000.0};
    for (int fault = 0; fault < 3; fault++)
        for (int place = 0; place < 2; place++) {
            host_start(3, 0, now, PLACES[place], 1);
            host_carriage()->back_drive = 0.0;
            if (fault == 0)
                host_carriage()->powered = false;
            else
                host_carriage()->stuck = fault == 1 ? 1 : -1;
            greet();
            CHECK(strstr(ask("HOME"), ",OK,HOMING,"));
            keep(4000);
            CHECK(host_state() == TAPPER_UNHOMED);
        }
}

static void test_missed_steps(void)
{
    /* All steps are lost: detected while charging, because the switch stays closed. */
    homed();
    host_carriage()->lose = 100000;
    CHECK(strstr(ask("CHARGE,1,12500,3000"), ",OK,CHARGING,"));
    keep(100);
    CHECK(host_state() == TAPPER_UNHOMED);
    CHECK(strstr(fire(1, 50), ",NOT_CHARGED,UNHOMED,"));
    /* Some steps are lost, on the way out or back: detected at the switch. */
    for (int back = 0; back < 2; back++) {
        homed();
        CHECK(strstr(ask("CHARGE,1,12500,3000"), ",OK,CHARGING,"));
        pass(50);
        if (!back)
            host_carriage()->lose = 16;
        keep(400);
        CHECK(host_state() == TAPPER_CHARGED);
        if (back)
            host_carriage()->lose = 16;
        CHECK(strstr(ask("DISCHARGE"), ",OK,"));
        keep(600);
        CHECK(host_state() == TAPPER_UNHOMED);
        host_carriage()->lose = 0;
        CHECK(strstr(ask("HOME"), ",OK,"));
        keep(600);
        CHECK(host_state() == TAPPER_SAFE);
    }
    /* The way out ends before the switch opens, and the way back is lost: nothing at the switch
     * shows this, so the switch's edge is found again. */
    for (uint32_t out = 1; out < 8; out++) {
        homed();
        CHECK(strstr(ask("CHARGE,1,12500,3000"), ",OK,CHARGING,"));
        pass(out);
        host_carriage()->back_drive = 0.0;
        host_carriage()->powered = false;
        CHECK(strstr(ask("DISCHARGE"), ",OK,"));
        keep(12);
        host_carriage()->powered = true;
        keep(100);
        CHECK(host_state() == TAPPER_SAFE);
        CHECK(fabs(host_carriage()->place) < 1.5);
    }
}

/* Somebody turns the screw while the motor's supply is off: no shot has more energy than requested. */
static void test_turned_by_hand(void)
{
    for (int charging = 0; charging < 2; charging++) {
        homed();
        host_carriage()->back_drive = 0.0;
        if (charging)
            CHECK(strstr(ask("CHARGE,1,1000,3000"), ",OK,CHARGING,"));
        host_carriage()->place = 400.0;
        host_carriage()->closed = false;
        keep(20);
        CHECK(host_state() == TAPPER_UNHOMED);
        CHECK(strstr(ask("CHARGE,2,1000,3000"), ",NOT_HOMED,UNHOMED,"));
        CHECK(strstr(ask("HOME"), ",OK,"));
        keep(600);
        CHECK(strstr(ask("CHARGE,2,1000,3000"), ",OK,CHARGING,"));
        keep(400);
        CHECK(host_state() == TAPPER_CHARGED && fabs(host_carriage()->place - 400.0) < 2.0);
    }
}

/* A stop with a switch that is stuck closed: the carriage does not go far in search of its edge. */
static void test_stop_with_stuck_switch(void)
{
    homed();
    host_carriage()->back_drive = 0.0;
    host_carriage()->stuck = 1;
    CHECK(strstr(ask("CHARGE,1,12500,3000"), ",OK,CHARGING,"));
    pass(3);
    host_receive((const uint8_t *)"!", 1, now);
    double before = host_carriage()->place;
    pass(400);
    CHECK(host_state() == TAPPER_STOPPED);
    CHECK(host_carriage()->place <= before + 2 * FRONT_HYSTERESIS_STEPS);
    press_button(600);
    CHECK(strstr(ask("CLEAR"), ",OK,UNHOMED,"));
}

static void test_setup_mode(void)
{
    homed();
    CHECK(strstr(ask("MODE,SETUP"), ",OK,"));
    CHECK(strstr(ask("STATUS"), ",SETUP,0,0,1,0*"));
    CHECK(strstr(ask("CHARGE,1,5001,3000"), ",NOT_ENABLED,SAFE,0,"));
    CHECK(strstr(ask("CHARGE,1,5000,3000"), ",OK,CHARGING,"));
    CHECK(strstr(ask("DISCHARGE"), ",OK,"));
    keep(600);
    host_enabling(1);
    CHECK(strstr(ask("CHARGE,2,12500,3000"), ",OK,CHARGING,"));
    keep(400);
    CHECK(strstr(ask("STATUS"), ",CHARGED,2,12500,1,0,0,0,3,") && strstr(host_output(), ",SETUP,1,0,1,0*"));
    host_enabling(0);
    pass(2);
    CHECK(host_state() == TAPPER_DISCHARGING);
    CHECK(strstr(fire(2, 50), ",NOT_CHARGED,"));
    keep(600);
    CHECK(strstr(ask("MODE,RUN"), ",OK,"));
    CHECK(strstr(ask("CHARGE,3,12500,3000"), ",OK,CHARGING,"));
    keep(400);
    CHECK(strstr(ask("MODE,SETUP"), ",OK,")); /* the stored energy now exceeds the limit */
    pass(2);
    CHECK(host_state() == TAPPER_DISCHARGING);
    CHECK(strstr(ask("MODE"), ",UNKNOWN,"));
    CHECK(strstr(ask("MODE,RUN,1"), ",UNKNOWN,"));
}

static uint32_t draw(uint32_t below)
{
    return (uint32_t)rand() % below;
}

/* Resets at random times in any state: the energy released afterwards is as requested. */
static void test_random_resets(void)
{
    double worst = 0.0;
    unsigned shots = 0;
    uint64_t shot = 0;
    host_start(1, 0, now, 0.0, 5);
    for (uint32_t reset = 0; reset < 1000; reset++) {
        /* Reset the board in any state; the spring may push the carriage back part of the way. */
        host_carriage()->back_drive = draw(2) ? 0.0 : (double)draw(8000);
        host_reset(reset + 1, shot, now);
        pass(draw(300));
        greet();
        for (int step = 0; step < 2; step++) {
            char words[80];
            uint32_t energy = 20 + draw(draw(2) ? 900000 : 5000);
            if (host_state() == TAPPER_UNHOMED)
                CHECK(strstr(ask("HOME"), ",OK,"));
            if (!step && draw(3) == 0)
                break; /* the next reset occurs during homing */
            for (int wait = 0; wait < 100 && host_state() != TAPPER_SAFE; wait++)
                keep(50);
            CHECK(host_state() == TAPPER_SAFE);
            snprintf(words, sizeof words, "CHARGE,%llu,%lu,10000", (unsigned long long)++shot,
                     (unsigned long)energy);
            CHECK(strstr(ask(words), ",OK,CHARGING,"));
            if (step)
                break; /* or while charging */
            for (int wait = 0; wait < 100 && host_state() != TAPPER_CHARGED; wait++)
                keep(50);
            CHECK(strstr(fire(shot, 50), ",FIRED,"));
            double place = host_released_from();
            double stored = 1e6 * 0.5 * 500.0 * (place * 5e-6) * (place * 5e-6);
            double error = fabs(stored - energy) / energy;
            worst = error > worst ? error : worst;
            shots++;
            CHECK(error <= 0.03);
        }
        pass(draw(3000));
    }
    printf("after 1000 random resets: %u shots, energy within %.2f %% of asked\n", shots,
           100.0 * worst);
}

/* However long a FIRE is delayed, it is executed before its deadline or not at all. */
static void test_random_delays(void)
{
    unsigned released = 0;
    uint64_t shot = 0;
    homed();
    for (int trial = 0; trial < 2000; trial++) {
        char words[80];
        snprintf(words, sizeof words, "CHARGE,%llu,1000,10000", (unsigned long long)++shot);
        CHECK(strstr(ask(words), ",OK,"));
        keep(150);
        CHECK(host_state() == TAPPER_CHARGED);
        uint32_t window = 1 + draw(100), delay = draw(4) ? draw(120) : draw(450);
        uint32_t deadline = now + window, before = host_releases();
        pass(delay);
        snprintf(words, sizeof words, "FIRE,%llu,%lu", (unsigned long long)shot,
                 (unsigned long)deadline);
        bool fired = strstr(ask(words), ",FIRED,") != 0;
        CHECK(fired == (delay < window));
        CHECK(host_releases() == before + fired);
        released += fired;
        pass(200);
        CHECK(host_releases() == before + fired);
    }
    printf("2000 delayed FIREs: %u released, none after its deadline\n", released);
}

static void test_frames(void)
{
    host_start(5, 0, now, 0.0, 1);
    greet();
    static const char *const BODIES[] = {
        "CHARGE,9,12500", "CHARGE,9,12500,3000,1,1", "CHARGE,9,,3000", "CHARGE,x,1,1", "FIRE",
        "FIRE,9", "FIRE,99999999999999999999,1", "FIREX,1,1", "", "STATUS,", "ARM,9,12500,3000",
    };
    for (unsigned i = 0; i < sizeof BODIES / sizeof BODIES[0]; i++) {
        CHECK(strstr(ask(BODIES[i]), ",UNKNOWN,"));
        CHECK(host_state() == TAPPER_UNHOMED);
    }
    homed();
    CHECK(strstr(ask("CHARGE,1,0,3000"), ",RANGE,"));
    CHECK(strstr(ask("CHARGE,1,1000001,3000"), ",RANGE,"));
    CHECK(strstr(ask("CHARGE,1,1,10001"), ",RANGE,"));
    CHECK(*send("0,1,HELLO") == 0);
    CHECK(*send("70000,1,HELLO") == 0);
    /* After noise of any kind, the board is safe and still answers. */
    for (uint32_t i = 0; i < 3000000; i++) {
        uint8_t byte = (uint8_t)(rand() >> 7);
        if (i % 7 == 0)
            byte = (uint8_t)"@*,\nA0"[rand() % 6];
        if (i % 100 == 0)
            pass(1);
        if (byte != '!')
            host_receive(&byte, 1, now);
        if (i % 1000 == 0)
            host_forget_output();
    }
    CHECK(host_state() == TAPPER_SAFE);
    CHECK(strstr(send("12,1,HELLO"), ",WELCOME,"));
}

/* Start a board with eight coils at fixed mounts and home it. */
static void coils_homed(void)
{
    host_coils(8);
    host_start(3, 0, now, 0.0, 1);
    greet();
    CHECK(host_state() == TAPPER_UNHOMED);
    CHECK(strstr(ask("CHARGE,1,12500,3000,2"), ",NOT_HOMED,"));
    pass(10);
    CHECK(strstr(ask("HOME"), ",OK,SAFE,"));
    CHECK(strstr(ask("STATUS"), ",RUN,0,0,8,255*"));
}

static void coil_charged(unsigned shot, unsigned channel)
{
    char words[60];
    snprintf(words, sizeof words, "CHARGE,%u,12500,3000,%u", shot, channel);
    CHECK(strstr(ask(words), ",OK,CHARGING,"));
    pass(2);
    CHECK(host_state() == TAPPER_CHARGED);
}

static const char *coil_fire(unsigned shot, unsigned channel)
{
    char words[60];
    snprintf(words, sizeof words, "FIRE,%u,%lu,%u", shot, (unsigned long)(uint32_t)(now + 40), channel);
    return ask(words);
}

static void test_channels(void)
{
    coils_homed();
    CHECK(strstr(ask("CHARGE,1,12500,3000,8"), ",CHANNEL,SAFE,0,"));
    for (unsigned channel = 0; channel < 8; channel++) {
        coil_charged(channel + 1, channel);
        CHECK(strstr(coil_fire(channel + 1, (channel + 1) % 8), ",CHANNEL,CHARGED,"));
        CHECK(strstr(coil_fire(channel + 1, channel), ",FIRED,RELEASING,"));
        CHECK(host_channel() == (int)channel);
        pass(100);
        CHECK(host_state() == TAPPER_DISCHARGING);
        char away[40], words[60];
        snprintf(away, sizeof away, ",%u,8,%u*", channel, 255u & ~(1u << channel));
        CHECK(strstr(ask("STATUS"), away));
        /* No other channel is charged while a striker is away from its mount. */
        snprintf(words, sizeof words, "CHARGE,%u,12500,3000,%u", channel + 2, (channel + 3) % 8);
        CHECK(strstr(ask(words), ",BUSY,"));
        keep(300);
        CHECK(host_state() == TAPPER_SAFE);
    }
    /* Requests without a channel use channel 0. */
    CHECK(strstr(ask("CHARGE,20,12500,3000"), ",OK,"));
    pass(2);
    CHECK(strstr(fire(20, 40), ",FIRED,"));
    CHECK(host_channel() == 0);
    keep(500);
    CHECK(host_state() == TAPPER_SAFE);
}

static void test_strikers_that_fail(void)
{
    coils_homed();
    host_strikers(300, 1 << 3, 0, 0); /* blocked: the striker does not leave its switch */
    coil_charged(1, 3);
    CHECK(strstr(coil_fire(1, 3), ",FIRED,"));
    keep(STRIKER_LEAVE_MS + 50);
    CHECK(host_state() == TAPPER_UNHOMED);
    host_strikers(300, 0, 0, 0);
    CHECK(strstr(ask("HOME"), ",OK,SAFE,"));

    host_strikers(100000, 0, 0, 0); /* the striker does not return */
    coil_charged(2, 4);
    CHECK(strstr(coil_fire(2, 4), ",FIRED,"));
    keep(STRIKER_RETURN_MS - 100);
    CHECK(host_state() == TAPPER_DISCHARGING);
    keep(200);
    CHECK(host_state() == TAPPER_UNHOMED);
    CHECK(strstr(ask("CHARGE,3,12500,3000,5"), ",NOT_HOMED,"));
    CHECK(strstr(ask("HOME"), ",OK,UNHOMED,"));

    coils_homed();
    host_strikers(300, 0, 1 << 6, 0); /* another striker is pulled off its mount while charged */
    coil_charged(4, 2);
    pass(10);
    CHECK(host_state() == TAPPER_UNHOMED);
    CHECK(strstr(coil_fire(4, 2), ",NOT_CHARGED,"));
    host_strikers(300, 0, 0, 0);
    pass(10);
    CHECK(strstr(ask("HOME"), ",OK,SAFE,"));

    host_strikers(300, 0, 0, 1 << 1); /* a switch that is stuck closed */
    coil_charged(5, 1);
    CHECK(strstr(coil_fire(5, 1), ",FIRED,"));
    keep(STRIKER_LEAVE_MS + 50);
    CHECK(host_state() == TAPPER_UNHOMED);
    host_coils(0);
}

int main(void)
{
    CHECK(tapper_crc("123456789", 9) == 0x29B1);
    srand(1);
    test_one_shot();
    test_window();
    test_sequence();
    test_discharging();
    test_stop_and_clear();
    test_shot_numbers();
    test_homing();
    test_missed_steps();
    test_turned_by_hand();
    test_stop_with_stuck_switch();
    test_setup_mode();
    test_random_resets();
    test_random_delays();
    test_frames();
    test_channels();
    test_strikers_that_fail();
    printf("tapper firmware: %d checks passed\n", checks);
    return 0;
}
